"""CLIP's tokenizer, rebuilt from the merges that OpenAI published (`data/bpe_simple_vocab...`).

Every CLIP shares it. `transformers` encodes; only vocabulary and merges are put together here, so
that no tokenizer file has to come with the weights.
"""

from __future__ import annotations

import gzip
import hashlib
import os
from collections.abc import Callable, Sequence

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.places import DATA

BPE_FILE = DATA / "bpe_simple_vocab_16e6.txt.gz"
BPE_SHA256 = "924691ac288e54409236115652ad4aa250f48203de50a9e4722a6ecd48d6804a"
VOCABULARY = 49408
_BOS, _EOS = "<|startoftext|>", "<|endoftext|>"  # the last two ids

Tokenizer = Callable[[Sequence[str]], list[list[int]]]


def load_tokenizer(positions: int) -> Tokenizer:
    """Returns sentences -> token ids: lower-cased, from bos to eos, at most `positions` of them.

    Raises:
        ConfigError: the shipped file is damaged, or `transformers` is not installed.

    Source: Radford et al. 2021, section 2.4; openai/CLIP: clip/simple_tokenizer.py for the order
    of the vocabulary. Its repair of garbled text and of HTML entities is left out, as it is in
    `transformers`.
    """
    content = BPE_FILE.read_bytes() if BPE_FILE.is_file() else b""
    if hashlib.sha256(content).hexdigest() != BPE_SHA256:
        cause = f"{BPE_FILE} is missing or is not the file that was published"
        raise ConfigError(cause, "install cmrl-jax again, or restore the file (git checkout)")
    os.environ.setdefault("TRANSFORMERS_NO_ADVISORY_WARNINGS", "1")  # "PyTorch was not found"
    try:
        # CLIPTokenizer alone: transformers' config classes would import torch where there is one.
        from transformers import CLIPTokenizer
    except ImportError as error:
        raise ConfigError(
            f"the tokenizer is missing: {error}", "pip install 'cmrl-jax[text]'"
        ) from None
    vocabulary, merges = read_bpe(content)
    # Annotated as lines of text, handed on to a model that takes pairs.
    tokenizer = CLIPTokenizer(vocab=vocabulary, merges=merges)  # pyright: ignore[reportArgumentType]

    def encode(sentences: Sequence[str]) -> list[list[int]]:
        return tokenizer(list(sentences), truncation=True, max_length=positions)["input_ids"]

    return encode


def read_bpe(content: bytes) -> tuple[dict[str, int], list[tuple[str, str]]]:
    """Returns the vocabulary (symbol -> id) and the merges, most frequent first.

    The file lists more merges than the vocabulary has room for. Its order: the 256 bytes, the same
    ending a word, one symbol a merge, bos, eos.
    """
    printable = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    others = 256 - len(printable)  # shown as the characters from U+0100 on
    single = [chr(code) for code in (*printable, *range(0x100, 0x100 + others))]
    lines = gzip.decompress(content).decode("utf-8").split("\n")[1:]  # the first names the version
    room = VOCABULARY - 2 * len(single) - 2
    merges = [(first, second) for first, second in (line.split() for line in lines[:room])]
    symbols = [*single, *(s + "</w>" for s in single), *(a + b for a, b in merges), _BOS, _EOS]
    return {symbol: number for number, symbol in enumerate(symbols)}, merges
