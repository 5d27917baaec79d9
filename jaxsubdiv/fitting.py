"""The package `fitting` that came with this one, under a name that no other distribution can take.

`import jaxsubdiv.fitting as fitting` is `import fitting`, unless another distribution of the name `fitting` comes first
on the path: then it loads ours from where it lies beside `jaxsubdiv`.
"""

import importlib.util
import sys
from pathlib import Path

_OWN = Path(__file__).resolve().parents[1] / "fitting" / "__init__.py"


def _find_own():
    spec = importlib.util.find_spec("fitting")
    if spec is not None and spec.origin is not None and Path(spec.origin).resolve() == _OWN:
        return importlib.import_module("fitting")
    spec = importlib.util.spec_from_file_location(__name__, _OWN, submodule_search_locations=[str(_OWN.parent)])
    assert spec is not None and spec.loader is not None
    module = sys.modules[__name__] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


sys.modules[__name__] = _find_own()
