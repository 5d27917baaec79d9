"""What speaks against a fit, by name and in numbers."""

import dataclasses
import json
from typing import NamedTuple


class Finding(NamedTuple):
    """One thing that speaks against a fit, or against where it started."""

    name: str
    """For programs: words in snake case that stay as they are."""
    text: str
    """For people: what was seen, in numbers, and what to do."""
    numbers: dict[str, float]
    """What was seen; lengths in mm, angles in degrees, shares from 0 to 1."""


class Pose(NamedTuple):
    """How a template was moved to its scan."""

    turned: float
    """Degrees."""
    scaled: float
    """Factor; the cube root of the change of volume."""
    moved: float
    """How far the template's middle went, in mm."""
    share_of_points: float
    """Part of the scan's points that lie near the template there, 0 to 1."""
    share_of_template: float
    """Part of the template's area that has points near, 0 to 1."""

    def __str__(self) -> str:
        return (
            f"turned by {self.turned:.0f} degrees, scaled by {self.scaled:.3f}, moved by {self.moved:.1f} mm; near "
            f"there {self.share_of_points:.0%} of the points and {self.share_of_template:.0%} of the template"
        )


@dataclasses.dataclass(frozen=True)
class Origin:
    """How a fit came to its start.

    Attributes:
        pose: of the template; None where there was none, or where it stayed in its place.
        findings: what spoke against the start.
    """

    pose: Pose | None = None
    findings: tuple[Finding, ...] = ()

    def to_json(self) -> str:
        """As JSON text, exact to the last bit."""
        pose = None if self.pose is None else self.pose._asdict()
        return json.dumps({"pose": pose, "findings": [finding._asdict() for finding in self.findings]})

    @classmethod
    def from_json(cls, text: str) -> "Origin":
        """What `to_json` wrote."""
        values = json.loads(text)
        pose = None if values["pose"] is None else Pose(**values["pose"])
        return cls(pose, tuple(Finding(**one) for one in values["findings"]))
