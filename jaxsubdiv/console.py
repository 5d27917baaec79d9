"""What a command prints: warnings in plain words, and streams that lose words but never end the work."""

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from typing import Any


@contextmanager
def simplify_warnings() -> Iterator[None]:
    """Print warnings of the block as `warning: ...` on stderr, unless they are errors or recorded."""
    shown = warnings.showwarning

    def show(message, category, filename, lineno, file=None, line=None):
        print(f"warning: {message}", file=sys.stderr)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = shown


@contextmanager
def survive_closed_streams() -> Iterator[None]:
    """Go on without words where stdout or stderr is closed, or is read by a command that ends before this one.

    Letters that the terminal's encoding lacks are printed as escapes.
    """
    with ExitStack() as stack:
        streams = [_Lasting(stack, stream) for stream in (sys.stdout, sys.stderr)]
        stack.enter_context(redirect_stdout(streams[0]))  # pyright: ignore[reportArgumentType]
        stack.enter_context(redirect_stderr(streams[1]))  # pyright: ignore[reportArgumentType]
        try:
            yield
        finally:
            for stream in streams:
                stream.flush()


class _Lasting:
    """A stream that takes words for as long as somebody reads them."""

    def __init__(self, stack: ExitStack, stream: Any):
        self._nowhere = stack.enter_context(open(os.devnull, "w"))
        self._stream = self._nowhere if stream is None else stream  # None: closed before Python began

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        text = text.encode(encoding, "backslashreplace").decode(encoding)
        self._try("write", text)
        return len(text)

    def flush(self) -> None:
        self._try("flush")

    def _try(self, name: str, *arguments: Any) -> None:
        try:
            getattr(self._stream, name)(*arguments)
        except (OSError, ValueError):  # nobody reads, the disk is full, or the stream was closed
            self._give_up()

    def _give_up(self) -> None:
        # What the stream still holds would fail once more when Python ends, and change the exit status.
        try:
            os.dup2(self._nowhere.fileno(), self._stream.fileno())
        except (OSError, ValueError, AttributeError):
            pass
        self._stream = self._nowhere


def colour(text: str) -> str:
    """Text in yellow where stdout is a terminal, unless the environment has `NO_COLOR`."""
    return f"\x1b[33m{text}\x1b[0m" if sys.stdout.isatty() and not os.environ.get("NO_COLOR") else text


def make_printable(text: str) -> str:
    """Text that can be written as UTF-8: bytes of a file's name that are no text become escapes such as `\\xe9`."""
    try:
        raw = text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # half of a pair, as names on Windows may hold
        raw = text.encode("utf-8", "surrogatepass")
    return raw.decode("utf-8", "backslashreplace")
