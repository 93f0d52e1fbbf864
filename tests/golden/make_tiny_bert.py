"""Makes tiny_bert.npz: a random two-layer BERT and what torch says its sentence vectors are.

Needs torch and transformers, which the tests do not: they only read the file.
    python tests/golden/make_tiny_bert.py
"""

from pathlib import Path

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from transformers import BertConfig, BertModel

SENTENCES = [[2, 5, 3], [2, 5, 6, 7, 3], [2, 19, 19, 8, 11, 4, 9, 3]]

torch.manual_seed(0)
config = BertConfig(
    vocab_size=20,
    hidden_size=16,
    num_hidden_layers=2,
    num_attention_heads=4,
    intermediate_size=24,
    max_position_embeddings=12,
    initializer_range=0.5,
)
model = BertModel(config, add_pooling_layer=False).eval()
arrays = {}
for name, tensor in model.state_dict().items():
    if name.endswith("bias") or "LayerNorm" in name:  # else 0 and 1, which would hide mistakes
        tensor.add_(0.3 * torch.randn_like(tensor))
    arrays[f"weights/{name}"] = tensor.numpy()
for index, ids in enumerate(SENTENCES):
    with torch.no_grad():
        pooled = model(torch.tensor([ids])).last_hidden_state[0].mean(0)
    arrays[f"ids/{index}"] = np.array(ids)
    arrays[f"vector/{index}"] = (pooled / pooled.norm()).numpy()
np.savez(Path(__file__).with_name("tiny_bert.npz"), **arrays)
