"""XML files of arrays, as VTP and GIfTI are: parsed and decoded within the size that they announce."""

import base64
import binascii
import lzma
import zlib
from pathlib import Path
from xml.etree import ElementTree

from ..errors import MeshError


def parse(path: Path, data: bytes, root: str) -> ElementTree.Element:
    """The element at the root, which has this name."""
    try:
        if b"<!ENTITY" in data:
            raise ValueError("it defines entities, which files of arrays have no use for")
        found = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise MeshError(
            f"{path.name}: it cannot be read as XML ({error}). It is damaged or of another format."
        ) from None
    if found.tag != root:
        raise MeshError(f"{path.name}: it is XML of '{found.tag[:40]}' and not of '{root}'. It is of another format.")
    return found


def from_base64(text: str) -> bytes:
    """The bytes of one or more pieces of base64, of which each but the last may end in padding.

    Raises:
        ValueError: it is no base64.
    """
    text = "".join(text.split())
    pieces, at = [], 0
    while at < len(text):
        end = text.find("=", at)
        end = len(text) if end < 0 else end + 1 + text.startswith("=", end + 1)
        try:
            pieces.append(base64.b64decode(text[at:end], validate=True))
        except binascii.Error as error:
            raise ValueError(f"no base64: {error}") from None
        at = end
    return b"".join(pieces)


def unpack(packed: bytes, n_bytes: int, kind: str = "zlib") -> bytes:
    """`n_bytes` out of what zlib or lzma packed.

    Raises:
        ValueError: it is damaged, or of another length.
    """
    # Neither packs tighter, so this much is never made room for in vain.
    if n_bytes > {"zlib": 1100, "lzma": 10_000}[kind] * len(packed):
        raise ValueError(f"{len(packed)} bytes cannot unpack to the {n_bytes} that are announced")
    opened = zlib.decompressobj() if kind == "zlib" else lzma.LZMADecompressor()
    try:
        data = opened.decompress(packed, n_bytes + 1)
    except (zlib.error, lzma.LZMAError) as error:
        raise ValueError(f"damaged: {error}") from None
    if len(data) != n_bytes:
        raise ValueError(f"{len(data)} bytes or more, where {n_bytes} are announced")
    return data
