"""Libraries of the optional extras."""

import importlib
from typing import Any


def import_extra(module: str, extra: str, what: str) -> Any:
    """Import a library of an optional extra.

    Args:
        module: its name as it is imported, such as `nibabel.gifti`.
        extra: the extra of `jaxsubdiv` that installs it.
        what: what needs the library, in the plural, with which the text of the error begins.

    Raises:
        ImportError: it cannot be imported; the text has the reason and the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{what} need {module.partition('.')[0]}, which cannot be imported ({error}). Install it with: "
            f"pip install 'jaxsubdiv[{extra}]'"
        ) from error
