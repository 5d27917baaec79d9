"""How the process keeps the memory that it has freed: a setting for whole programs, never made by an import."""

import ctypes

# glibc's names, from malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST_INT = 2**31 - 1


def keep_freed_memory() -> bool:
    """Let glibc keep large freed arrays for the next ones, instead of handing them back to the system each time.

    By default arrays of 32 MiB and more are mapped anew at every call, and their first touch then costs more than the
    refinement. Call it once at the start of a script or notebook that refines large meshes again and again on the CPU;
    the process stays as large as its largest moment.

    Returns:
        Whether it took effect: not without glibc (macOS, Windows, musl).
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGEST_INT)) and bool(mallopt(_TRIM_THRESHOLD, _LARGEST_INT))
