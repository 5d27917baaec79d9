"""Files that tests write."""

from pathlib import Path

import numpy as np

ROWS = np.random.default_rng(0).normal(scale=0.1, size=(30, 3)).astype(np.float32)


def put(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def lines(rows) -> str:
    return "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in rows)
