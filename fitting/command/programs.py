"""Compiled programs and memory, kept from run to run, and threads."""

import os
from pathlib import Path

import jax

import jaxsubdiv as js

_THREADS = {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"}


def keep_compiled_programs() -> None:
    """Keep freed memory, and compiled programs from run to run, unless the environment says where already."""
    js.keep_freed_memory()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and (cache := _make_cache()) is not None:
        jax.config.update("jax_compilation_cache_dir", str(cache))
    _compile_quickly()
    # A fit compiles many small programs besides few large ones: they are kept too.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def calculate_in_one_thread() -> None:
    """Have the libraries of numpy and scipy solve in one thread, unless the environment gives a number: the matrices of
    a fit are small, and on busy cores their threads wait for one another, ten times as long as the work takes."""
    if _THREADS.isdisjoint(os.environ):
        try:
            from threadpoolctl import threadpool_limits
        except ImportError:
            return
        threadpool_limits(1, "blas")


def _compile_quickly() -> None:
    """Have XLA's older emitters make programs for the CPU: in two thirds of the time, to run as fast."""
    flags = os.environ.get("XLA_FLAGS", "")
    # later versions may have no others, and end Python where they do not know a flag
    if jax.__version_info__ < (0, 11) and "xla_cpu_use_fusion_emitters" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_use_fusion_emitters=false"


def _make_cache() -> Path | None:
    """The folder of compiled programs; None where the user has no home folder, or may not write there."""
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxsubdiv"
        cache.mkdir(parents=True, exist_ok=True)
    except (RuntimeError, OSError):
        return None
    return cache if os.access(cache, os.W_OK) else None
