"""A bar of sweeps, or a line a sweep."""

from ..run.fit import Sweep


class Progress:
    """A bar where tqdm is installed, else a line a sweep."""

    def __init__(self, max_sweeps: int):
        self._max_sweeps = max_sweeps

    def __enter__(self) -> "Progress":
        try:
            from tqdm import tqdm
        except ImportError:
            self._bar = None
        else:
            self._bar = tqdm(total=self._max_sweeps, unit="sweep", desc="sweeps at most", leave=False, disable=None)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def stage(self, words: str) -> None:
        text = f"now      {words}"
        if self._bar is None:
            print(text)
        else:
            self._bar.reset()
            self._bar.write(text)

    def update(self, sweep: Sweep) -> None:
        if self._bar is None:
            print(f"sweep {sweep.number:3d}  RMS {sweep.rms:.3f} mm")
        else:
            self._bar.set_postfix_str(f"RMS {sweep.rms:.3f} mm")
            self._bar.update(sweep.number - self._bar.n)  # a fit that goes on does not begin at 1
