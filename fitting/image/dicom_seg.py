"""DICOM segmentations, by highdicom."""

from pathlib import Path
from typing import Any

import numpy as np

from ..scan.scan import ScanError
from .need import need
from .volume import Label, Volume


def read(path: Path) -> Volume:
    """The volume, in LPS, a layer a segment: they may overlap."""
    highdicom = need("highdicom")
    try:
        segmentation: Any = highdicom.seg.segread(path)
        volume = segmentation.get_volume(combine_segments=False)
        layers = np.moveaxis(np.asarray(volume.array), -1, 0)
        affine = np.asarray(volume.affine, np.float64)
        named = [(n, segmentation.get_segment_description(n).segment_label) for n in segmentation.segment_numbers]
    except Exception as error:  # of pydicom, highdicom and whatever they call on what is damaged
        raise ScanError(f"it is no DICOM segmentation in even slices, or damaged: {error!r}.") from None
    labels = tuple(Label(int(number), str(name), layer) for layer, (number, name) in enumerate(named))
    valued = tuple((layer > 0) * np.int32(label.value) for layer, label in zip(layers, labels, strict=True))
    # Slices without any segment are not stored: past the last there is nothing, not the end of what was seen.
    return Volume(valued, affine, "LPS", labels).padded((1, 0, 0), (1, 0, 0))
