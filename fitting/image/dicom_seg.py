"""DICOM segmentations, by highdicom."""

import math
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from jaxsubdiv.extras import import_extra

from ..scan.scan import ScanError
from .room import DEFLATED, check_room
from .volume import Label, Volume


def read(path: Path) -> Volume:
    """The volume, in LPS, with a layer a segment where they overlap.

    A voxel that has a segment by a probability has it from a half on.
    """
    highdicom = import_extra("highdicom", "images", "DICOM segmentations")
    data = path.read_bytes()  # from a file pydicom would ask for as many bytes as a damaged length says
    try:
        segmentation: Any = highdicom.seg.segread(BytesIO(data))
        geometry = segmentation.get_volume_geometry()
        if geometry is not None:  # slices may be missing, so that few of them say anything of a size
            check_room(math.prod(int(n) for n in geometry.spatial_shape) // 8 + 1, len(data), DEFLATED)
        numbers = [int(n) for n in segmentation.segment_numbers]
        names = [str(segmentation.get_segment_description(n).segment_label) for n in numbers]
        try:
            volume = segmentation.get_volume(combine_segments=True)
            layers = (np.asarray(volume.array),)
        except (RuntimeError, ValueError):  # some overlap, or are probabilities
            # Read anew: the one that failed holds on to its table of frames.
            volume = highdicom.seg.segread(BytesIO(data)).get_volume(combine_segments=False)
            each = np.moveaxis(np.asarray(volume.array), -1, 0)
            kind = np.min_scalar_type(max(numbers))
            layers = tuple((one >= 0.5) * kind.type(n) for one, n in zip(each, numbers, strict=True))
        affine = np.asarray(volume.affine, np.float64)
    except (MemoryError, ScanError):
        raise
    except Exception as error:  # of pydicom, highdicom and whatever they call on what is damaged
        raise ScanError(f"it is no DICOM segmentation in even slices, or damaged: {error!r}.") from None
    labels = tuple(
        Label(n, name, min(at, len(layers) - 1)) for at, (n, name) in enumerate(zip(numbers, names, strict=True))
    )
    # Slices without any segment are not stored: past the last there is nothing, not the end of what was seen.
    return Volume(layers, affine, "LPS", labels).pad((1, 0, 0), (1, 0, 0))
