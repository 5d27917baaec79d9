"""The extra that images need, and how much a packed file may hold."""

import importlib
from types import ModuleType

from ..scan.scan import ScanError

# The most that deflate packs; more is announced only by what is damaged, or made to fill memory.
_MOST_PACKED = 1032


def need(module: str) -> ModuleType:
    """A library of the extra `images`.

    Raises:
        ImportError: it is missing; the text tells how to get it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"this image needs the extra `images`: pip install 'jaxsubdiv[images]' ({error}).") from error


def check_room(announced: int, size: int, packed: bool) -> None:
    """See that a file can hold what its header announces, before anything is made of that size.

    Args:
        announced: bytes of the voxels.
        size: of the file, in bytes.
        packed: whether its voxels are compressed.
    """
    if announced <= 0 or announced > size * (_MOST_PACKED if packed else 1):
        raise ScanError(
            f"its header announces {announced:,} bytes of voxels, and the file has {size:,}. It is damaged."
        )
