"""Damage of the kinds that files meet: cuts, changed bytes, other numbers, parts twice or missing."""

import gzip
import io
import re
import zipfile

import numpy as np

_TOKENS = [
    *(b"0", b"-1", b"1e999", b"nan", b"inf", b"-inf", b"1_0", b"3.5", b"0x10", b"2000000000", b"9223372036854775808"),
    *(b"-9223372036854775809", b"9" * 400, b"9" * 5000, b"1,5", b"", b"\xef\xbc\x93", b"\xff", b"\0", b'"', b"#"),
    *(b"\n", b"\r", b"\\\n", b"\t", b";", b"//", b"<", b">", b"&#0;", b"null", b"true", b"[]", b"{}", b"[" * 3000),
    *(b"=" * 5, b"<!ENTITY a 'b'>", b"4294967295", b"|O", b"<M8[ns]", b"<U9", b"<c16", b"(9999999999,)", b"LPS"),
]
_BINARY = [b"\0" * 8, b"\xff" * 8, b"\xff\x7f" * 4, b"\1" + b"\0" * 7, b"\0\0\xc0\x7f" * 2, b"\0\0\x80\x7f" * 2]
_BINARY += [b"\2\0\0\0" * 2, b"\0\0\0\x7f" * 2, b"\x20\0" * 4, b"\0\2" * 4, b"\0\x10\0\0\0\0\0\0"]
_NUMBER = re.compile(rb"[-+]?[0-9]+(\.[0-9]+)?")
_WORD = re.compile(rb"[A-Za-z_]+")


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with one or two kinds of damage; archives often inside of what is packed, with sums that fit."""
    if data.startswith(b"PK") and rng.random() < 0.7:
        return _in_member(data, rng)
    if data.startswith(b"\x1f\x8b") and rng.random() < 0.8:
        return gzip.compress(mutated(gzip.decompress(data), rng), mtime=0)
    for _ in range(int(rng.integers(1, 3))):
        data = _damaged(data, rng)
    return data


def _in_member(data: bytes, rng: np.random.Generator) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        chosen = names[int(rng.integers(len(names)))]
        for name in names:
            held = old.read(name)
            if name == chosen:
                if rng.random() < 0.05:
                    continue
                held = _damaged(held, rng)
            new.writestr(name, held)
    return file.getvalue()


def _damaged(data: bytes, rng: np.random.Generator) -> bytes:
    at, until = sorted(int(i) for i in rng.integers(0, len(data) + 1, 2))
    token = _TOKENS[int(rng.integers(len(_TOKENS)))]
    match int(rng.integers(10)):
        case 0:
            return data[:at]
        case 1:
            return data[:at] + rng.bytes(int(rng.integers(1, 9))) + data[at + int(rng.integers(0, 9)) :]
        case 2:
            return data[:at] + token + data[at:]
        case 3:
            return data[:at] + data[until:]
        case 4:
            return data[:until] + data[at:]
        case 5 if len(data):
            at = min(at, len(data) - 1)
            return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]
        case 6 if len(data) > 2:  # a number of a binary header
            size = int(rng.choice([2, 4, 8]))
            at = size * int(min(len(data), 600) * rng.random() // size)
            return data[:at] + _BINARY[int(rng.integers(len(_BINARY)))][:size] + data[at + size :]
        case 7:
            return _replaced(data, _WORD, token, rng)
        case _:
            return _replaced(data, _NUMBER, token, rng)


def _replaced(data: bytes, pattern: re.Pattern[bytes], token: bytes, rng: np.random.Generator) -> bytes:
    """One match replaced, of those in the first part of the file more often: counts stand there."""
    found = list(pattern.finditer(data))[:2000]
    if not found:
        return data + token
    match = found[int(len(found) * rng.random() ** 2)]
    return data[: match.start()] + token + data[match.end() :]
