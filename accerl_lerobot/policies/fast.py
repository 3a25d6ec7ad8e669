# SPDX-License-Identifier: Apache-2.0
"""FAST's action tokeniser (Pertsch et al., arXiv 2501.09747), read from its files without running their code.

A chunk is transformed along time (orthonormal DCT-II), scaled and rounded; the coefficients, row by row of
frequency, become characters, which byte-pair encoding merges into tokens. Decoding turns that around. Many
token sequences decode to the same chunk.

On the Hub such a tokeniser comes as JSON beside a Python file, and LeRobot runs the newest version of that
file with full rights. The JSON is all there is to know, so `data_only` has LeRobot use this class instead.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

CONFIG = "processor_config.json"


@dataclass(frozen=True, kw_only=True)
class FastTokenizer:
    """FAST's tokeniser with the methods that LeRobot calls."""

    bpe_tokenizer: Any
    """Merges characters into tokens, a `PreTrainedTokenizerFast`."""
    scale: float
    """By which coefficients are multiplied before they are rounded."""
    min_token: int
    """The coefficient that character 0 stands for."""
    folder: Path
    """Where its files are."""

    @classmethod
    def from_pretrained(cls, name: str, **options: Any) -> FastTokenizer:
        """Reads a folder, or the JSON files of a Hub repository; no option changes that.

        Raises:
            OSError: it is neither, or has no tokeniser in it.
        """
        from huggingface_hub import snapshot_download
        from transformers import PreTrainedTokenizerFast

        from accerl_lerobot.hub.errors import guard_client

        guard_client()
        folder = Path(name)
        if not folder.is_dir():
            folder = Path(snapshot_download(name, allow_patterns=["*.json"]))
        config = json.loads((folder / CONFIG).read_text())
        return cls(
            bpe_tokenizer=PreTrainedTokenizerFast.from_pretrained(folder),
            scale=config["scale"],
            min_token=config["min_token"],
            folder=folder,
        )

    def __call__(self, chunks: Any) -> list[list[int]]:
        """Tokens of each of the chunks (B, K, A)."""
        chunks = np.asarray(chunks, dtype=np.float64)
        coefficients = np.around(_dct(chunks.shape[-2]) @ chunks * self.scale)
        characters = np.maximum(coefficients - self.min_token, 0).astype(int)
        texts = ["".join(map(chr, each.flatten())) for each in characters]
        return [self.bpe_tokenizer(text)["input_ids"] for text in texts]

    def save_pretrained(self, directory: Path) -> None:
        """Copies its files; code, where it lies beside them, for those who run it."""
        directory.mkdir(parents=True, exist_ok=True)
        for file in self.folder.iterdir():
            if file.suffix in (".json", ".py") and not (directory / file.name).exists():
                shutil.copyfile(file, directory / file.name)


@contextlib.contextmanager
def data_only() -> Iterator[None]:
    """While it lasts, LeRobot reads the tokenisers of π0-FAST and runs no code that comes with them."""
    from lerobot.policies.pi0_fast import modeling_pi0_fast
    from lerobot.processor import tokenizer_processor

    modules = (modeling_pi0_fast, tokenizer_processor)
    kept = [(module.AutoProcessor, module.AutoTokenizer) for module in modules]
    for module in modules:
        module.AutoProcessor, module.AutoTokenizer = FastTokenizer, _TextTokenizer
    try:
        yield
    finally:
        for module, (processor, tokenizer) in zip(modules, kept, strict=True):
            module.AutoProcessor, module.AutoTokenizer = processor, tokenizer


class _TextTokenizer:
    @staticmethod
    def from_pretrained(name: str, **options: Any) -> Any:
        from transformers import AutoTokenizer

        return AutoTokenizer.from_pretrained(name, **options | {"trust_remote_code": False})


def _dct(size: int) -> np.ndarray:
    """Orthonormal DCT-II as a matrix (size, size): frequencies by times."""
    times, frequencies = np.arange(size) + 0.5, np.arange(size)[:, None]
    matrix = np.cos(np.pi / size * frequencies * times) * np.sqrt(2 / size)
    matrix[0] /= np.sqrt(2)
    return matrix
