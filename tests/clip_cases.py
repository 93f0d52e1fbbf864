"""What the CLIP text tower is tried on: architectures, random weights, sentences, raw token rows.

Needs numpy and `regex` alone, so that `scripts/clip_golden.py` reads it where torch is and the
tests read it where jax is: both sides make the same weights and, with the tokenizer written down
here a second time, the same token ids.
"""

import functools
import gzip
import hashlib
import unicodedata
from pathlib import Path

import numpy as np
import regex

ROOT = Path(__file__).resolve().parent.parent
BPE_FILE = ROOT / "cmrl_jax" / "data" / "bpe_simple_vocab_16e6.txt.gz"
GOLDEN = Path(__file__).parent / "golden" / "clip_text.npz"
BOS, EOS = 49406, 49407

# The text_config of each, as `transformers` writes it. Two ids beyond the vocabulary of the BPE
# file let the two eos rules differ.
ARCHITECTURES = {
    "gelu": {
        "vocab_size": 49410,
        "hidden_size": 32,
        "intermediate_size": 48,
        "projection_dim": 24,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "max_position_embeddings": 77,
        "hidden_act": "gelu",
        "layer_norm_eps": 1e-3,
        "eos_token_id": EOS,
    },
    "legacy-eos": {
        "vocab_size": 49410,
        "hidden_size": 48,
        "intermediate_size": 128,
        "projection_dim": 16,
        "num_hidden_layers": 3,
        "num_attention_heads": 3,
        "max_position_embeddings": 20,
        "hidden_act": "quick_gelu",
        "layer_norm_eps": 1e-5,
        "eos_token_id": 2,
    },
    "b32": {
        "vocab_size": 49408,
        "hidden_size": 512,
        "intermediate_size": 2048,
        "projection_dim": 512,
        "num_hidden_layers": 12,
        "num_attention_heads": 8,
        "max_position_embeddings": 77,
        "hidden_act": "quick_gelu",
        "layer_norm_eps": 1e-5,
        "eos_token_id": 2,
    },
}
SENTENCES = (
    "open the drawer",
    "close the drawer",
    "Push the WINDOW shut!",
    "",
    "   ",
    "a photo of a cat",
    "  tabs\tand\n\nnew   lines  ",
    "don't, we'll: it's they've I'm he'd you're",
    "gripper2000 at 3.14159 m/s",
    "ouvre la fenêtre, s'il te plaît",
    "cafe\u0301 and café are one word",  # decomposed and composed
    "öffne die Schublade — schnell…",
    "открой ящик",
    "打开抽屉",
    "افتح الدرج",
    "🤖 pulls 🚪👍🏽",
    "antidisestablishmentarianism floccinaucinihilipilification",
    "<>&amp; {json: [1, 2]} #hash @at",
    "pull the drawer towards you and then " * 12,
    "Ωμέγα µ ½ ﬁ ²",
)
# Rows with an id above eos before it: the legacy rule pools there, the other at the first eos.
RAW_ROWS = (
    (BOS, 320, 49409, 1125, EOS, EOS),
    (BOS, 320, EOS, 49408, 7, EOS),
)


def random_tensors(config: dict, seed: int = 0) -> dict[str, np.ndarray]:
    """Weights under torch's names, float32, large enough that every part of the tower matters."""
    width, inner = config["hidden_size"], config["intermediate_size"]
    shapes: dict[str, tuple[int, ...]] = {
        "text_model.embeddings.token_embedding.weight": (config["vocab_size"], width),
        "text_model.embeddings.position_embedding.weight": (
            config["max_position_embeddings"],
            width,
        ),
    }
    for layer in range(config["num_hidden_layers"]):
        at = f"text_model.encoder.layers.{layer}"
        for name in ("q_proj", "k_proj", "v_proj", "out_proj"):
            shapes[f"{at}.self_attn.{name}.weight"] = (width, width)
            shapes[f"{at}.self_attn.{name}.bias"] = (width,)
        for name in ("layer_norm1", "layer_norm2"):
            shapes[f"{at}.{name}.weight"] = shapes[f"{at}.{name}.bias"] = (width,)
        shapes[f"{at}.mlp.fc1.weight"], shapes[f"{at}.mlp.fc1.bias"] = (inner, width), (inner,)
        shapes[f"{at}.mlp.fc2.weight"], shapes[f"{at}.mlp.fc2.bias"] = (width, inner), (width,)
    for name in ("weight", "bias"):
        shapes[f"text_model.final_layer_norm.{name}"] = (width,)
    shapes["text_projection.weight"] = (config["projection_dim"], width)
    rng = np.random.default_rng(seed)
    tensors = {}
    for name, shape in shapes.items():
        values = 2 * rng.random(shape, np.float32) - 1
        if "norm" in name:
            values = 0.4 * values + (1 if name.endswith("weight") else 0)
        elif "embedding" not in name and len(shape) == 2:
            values *= np.float32(1.7 / np.sqrt(shape[1]))
        tensors[name] = values.astype(np.float32)
    return tensors


def fingerprint(tensors: dict[str, np.ndarray]) -> str:
    """sha256 of the weights: numpy may change its random stream in a later version."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode() + tensors[name].tobytes())
    return digest.hexdigest()


def reference_rows(positions: int) -> list[list[int]]:
    """Token ids of `SENTENCES`, cut to `positions`, bos and eos included."""
    return [
        [BOS, *reference_ids(" ".join(text.split()))[: positions - 2], EOS] for text in SENTENCES
    ]


def reference_ids(text: str) -> list[int]:
    """Byte-pair encoding as defined: the most frequent known pair of a word is joined, again.

    Source: Sennrich et al. 2016, algorithm 1; Radford et al. 2021 (CLIP) for the details.
    """
    number, rank = vocabulary()
    text = unicodedata.normalize("NFC", text).lower()
    pattern = r"'s|'t|'re|'ve|'m|'ll|'d|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+"
    ids = []
    for word in regex.findall(pattern, text):
        symbols = [byte_symbols()[byte] for byte in word.encode()]
        symbols[-1] += "</w>"
        while len(symbols) > 1:
            pairs = list(zip(symbols, symbols[1:], strict=False))
            best = min(pairs, key=lambda pair: rank.get(pair, len(rank)))
            if best not in rank:
                break
            joined = []
            while symbols:
                if tuple(symbols[:2]) == best:
                    joined.append("".join(best))
                    symbols = symbols[2:]
                else:
                    joined.append(symbols.pop(0))
            symbols = joined
        ids += [number[symbol] for symbol in symbols]
    return ids


@functools.cache
def byte_symbols() -> dict[int, str]:
    """A visible character for each byte: itself where it has one, else the next from U+0100 on."""
    visible = [*range(33, 127), *range(161, 173), *range(174, 256)]
    hidden = [byte for byte in range(256) if byte not in visible]
    return {b: chr(b) for b in visible} | {b: chr(256 + i) for i, b in enumerate(hidden)}


@functools.cache
def vocabulary() -> tuple[dict[str, int], dict[tuple[str, str], int]]:
    """(symbol -> id, pair -> rank) of CLIP: 256 bytes, 256 ending a word, 48,894 merges."""
    lines = gzip.decompress(BPE_FILE.read_bytes()).decode("utf-8").split("\n")
    pairs = [(a, b) for a, b in (line.split() for line in lines[1 : 49152 - 256 - 2 + 1])]
    single = list(byte_symbols().values())
    symbols = single + [s + "</w>" for s in single] + [a + b for a, b in pairs]
    return {s: i for i, s in enumerate(symbols)}, {pair: i for i, pair in enumerate(pairs)}
