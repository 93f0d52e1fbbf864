"""Writes what torch's CLIPTextModelWithProjection says of the cases in tests/clip_cases.py.

For an environment with torch, transformers and safetensors; cmrl_jax is not needed there and
needs none of them. Without flags it writes tests/golden/clip_text.npz, which the tests read:

    python scripts/clip_golden.py
    python scripts/clip_golden.py --architecture b32 --out b32.npz     # too slow for every test run

and where jax is, `--compare b32.npz` prints the largest difference of cmrl_jax's tower to it.
"""

import argparse
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import clip_cases as cases


def outputs(name: str) -> dict[str, np.ndarray]:
    """Text vectors of an architecture, not normalised, from a checkpoint saved and loaded again."""
    import torch
    from safetensors.numpy import save_file
    from transformers import CLIPTextConfig, CLIPTextModelWithProjection

    config = cases.ARCHITECTURES[name]
    tensors = cases.random_tensors(config)
    with tempfile.TemporaryDirectory() as directory:
        save_file(tensors, Path(directory) / "model.safetensors", metadata={"format": "pt"})
        CLIPTextConfig(**config).save_pretrained(directory)
        model, info = CLIPTextModelWithProjection.from_pretrained(
            directory, output_loading_info=True
        )
    assert not info["missing_keys"] and not info["unexpected_keys"], info
    model.eval()
    rows = [*cases.reference_rows(config["max_position_embeddings"])]
    rows += cases.RAW_ROWS if config["vocab_size"] > cases.EOS + 1 else ()
    found = {f"{name}/weights_sha256": np.array(cases.fingerprint(tensors))}
    with torch.no_grad():
        vectors = [model(torch.tensor([list(row)])).text_embeds[0].numpy() for row in rows]
    longest = max(map(len, rows))
    found[f"{name}/ids"] = np.array([[*row, *[-1] * (longest - len(row))] for row in rows])
    found[f"{name}/vectors"] = np.stack(vectors)
    return found


def difference(name: str, data: Mapping[str, np.ndarray]) -> float:
    """The largest difference of cmrl_jax's tower to torch's vectors, as `outputs` returns them."""
    from cmrl_jax.text.clip_text import Architecture, text_vectors, to_params

    config = cases.ARCHITECTURES[name]
    tensors = cases.random_tensors(config)
    assert cases.fingerprint(tensors) == str(data[f"{name}/weights_sha256"])
    architecture = Architecture.read({"model_type": "clip_text_model", **config})
    rows = [row[row >= 0].tolist() for row in data[f"{name}/ids"]]
    assert rows[: len(cases.SENTENCES)] == cases.reference_rows(config["max_position_embeddings"])
    ours = text_vectors(architecture, to_params(tensors, architecture), rows)
    return float(np.abs(ours - data[f"{name}/vectors"]).max())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--architecture", choices=cases.ARCHITECTURES)
    parser.add_argument("--out", type=Path, default=cases.GOLDEN)
    parser.add_argument("--compare", type=Path, metavar="F")
    args = parser.parse_args()
    if args.compare:
        with np.load(args.compare) as data:
            for name in sorted({key.partition("/")[0] for key in data}):
                print(f"{name}: largest difference {difference(name, data):.2e}")
    else:
        names = [args.architecture] if args.architecture else ["gelu", "legacy-eos"]
        np.savez_compressed(
            args.out, **{key: value for name in names for key, value in outputs(name).items()}
        )
        print(args.out)
