"""Settings of every test: double precision, no silent promotion, shapes checked while the code runs."""

import atexit
import itertools
import os
import shutil
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy loads: threads of two workers wait for one another
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # workers find it there: what one has compiled, the others load
    _programs = tempfile.mkdtemp(prefix="jaxsubdiv_tests_")
    atexit.register(shutil.rmtree, _programs, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _programs
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"

import jax
import jaxtyping
import pytest
from jax.experimental.compilation_cache import compilation_cache

# XLA's newer emitters take three times as long to compile, and every program here is compiled to run a few times. Given
# before the first program is compiled, and in the environment, so that commands in processes of their own have it too.
if jax.__version_info__ < (0, 11):  # later ones may have no others, and end Python where they do not know a flag
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false"
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)  # programs that run a few times take longer to be made fast
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jaxtyping.install_import_hook(["jaxsubdiv", "fitting"], "beartype.beartype")  # before anything imports them

_ROOT = Path(__file__).parents[1]
_MAPS, _MOST_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_tests = itertools.count()
_LONGEST = (
    "test_notebooks",
    "test_posterior",
    "test_gradients",
    "test_likeness",
    "test_engine",
    "test_fit",
    "test_examples",
    "test_command_fit",
    "test_command_endings",
)


def pytest_configure(config):
    """Let xdist begin with what was collected first; of itself it leaves files of few tests to the end."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items):
    """Begin with the files that take longest, so that no worker is left with one of them."""
    items.sort(key=lambda item: _LONGEST.index(item.path.stem) if item.path.stem in _LONGEST else len(_LONGEST))


@pytest.fixture(autouse=True)
def room_for_programs():
    """Every compiled program holds a hundred memory maps, and where Linux has no more of them the compiler crashes."""
    yield
    if next(_tests) % 16 == 0 and _MAPS.exists():
        if _MAPS.read_bytes().count(b"\n") > int(_MOST_MAPS.read_text()) / 2:
            jax.clear_caches()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the scans and control meshes that are too large to ship; a test that needs it is skipped without."""
    for folder in (_ROOT / "shared" / "data", _ROOT.parent / "shared" / "data"):
        if folder.is_dir():
            return folder
    pytest.skip("the shared data are not beside this checkout")


@pytest.fixture
def as_users_run():
    """Without the checks of annotations, which would speak before the library's own words on bad arguments."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def command_settings(tmp_path, monkeypatch):
    """The commands' settings of JAX put back, and nothing written into the home folder."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    names = ("jax_enable_x64", "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()  # once in use it would take the programs of all tests after this one, too
