"""How much a packed file may hold."""

from ..scan.scan import ScanError

# The most bytes that one of these holds; more is announced only by what is damaged, or made to fill memory.
DEFLATED, BZIPPED = 1032, 1 << 20


def check_room(announced: int, size: int, most: int) -> None:
    """See that a file can hold what its header announces, before anything is made of that size.

    Args:
        announced: bytes of the voxels.
        size: of the file, in bytes.
        most: that one byte of the file may stand for: 1 where nothing is compressed, else `DEFLATED` or `BZIPPED`.
    """
    if announced <= 0 or announced > size * most:
        raise ScanError(
            f"its header announces {announced:,} bytes of voxels, and the file has {size:,}. It is damaged."
        )
