"""Formats of the files that people keep: a number in each, and how older ones are brought up to
date.

A file without a number has the first.  When what is written changes, the format's number grows here
by one, `since` becomes the release that is the first to read it, and a step is added that makes of
what was written before what is written now.  Files of every release lie in tests/golden, whose test
reads them for ever.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from constraint_geodesics.values import shown

Step = Callable[[dict[str, Any]], dict[str, Any]]
"""From what a file holds, entries by name, to the same in the next format."""
NUMBER, SINCE = "format", "since"
"""Names of the entries that say it."""
_RELEASE = r"[\w.]{1,40}"
_SAID = re.compile(
    rf"(?P<number>\d{{1,9}})(?: \(constraint_geodesics (?P<since>{_RELEASE})\))?", re.ASCII
)


class FormatError(ValueError):
    """A file of a format that this release can't read; the message has no name of the file."""


@dataclass(frozen=True)
class Format:
    """Of one kind of file.  number: what is written.  since: the first release that reads it.
    steps: from each older number to the one after it; without one the number is the only one.
    """

    number: int
    since: str = "0.1.0"
    steps: Mapping[int, Step] = field(default_factory=dict)

    @property
    def entries(self) -> dict[str, Any]:
        """What a file of entries by name says of its format."""
        return {NUMBER: self.number, SINCE: self.since}

    @property
    def line(self) -> str:
        """What a file of lines says, after `# format: `."""
        return f"{self.number} (constraint_geodesics {self.since})"

    def require(self, number: Any, since: Any = None) -> int:
        """The number of a file, if this release reads it.  since: what the file says of the first
        release that does.  Raises FormatError for a newer one, one of no release, and what is no
        number.
        """
        if type(number) is not int or number < 1:
            raise FormatError(f"format {shown(number)}: must be a whole number of at least 1")
        if number > self.number:
            known = isinstance(since, str) and re.fullmatch(_RELEASE, since)
            later = f"constraint_geodesics {since}" if known else "a later constraint_geodesics"
            reads = f"this one reads up to format {self.number}"
            raise FormatError(f"format {shown(number)}: {later} reads it; {reads}")
        oldest = min(self.steps, default=self.number)
        if number < oldest:
            reads = f"this one reads from format {oldest} on"
            raise FormatError(f"format {number}: no release wrote it; {reads}")
        return number

    def require_line(self, text: str) -> None:
        """The same of a line's text, as `line` writes it, or a number alone; other texts are
        remarks of other people.
        """
        said = _SAID.fullmatch(text.strip())
        if said is not None:
            self.require(int(said["number"]), said["since"])

    def updated(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """What a file of entries by name holds, without its format, as files hold it now.  Raises
        FormatError.
        """
        number = self.require(content.get(NUMBER, 1), content.get(SINCE))
        found = {name: value for name, value in content.items() if name not in (NUMBER, SINCE)}
        for older in range(number, self.number):
            found = self.steps[older](found)
        return found


TABLE = Format(1)
"""Joints in CSV: a trajectory, and demonstrations."""
SCENE = Format(1)
"""Shapes in YAML, around the robot or attached."""
CONSTRAINT = Format(1)
"""An identified constraint in YAML."""
RECORDING = Format(1)
"""What a Rerun recording is said to hold at `/about`; Rerun has a format of its own below it."""
PLANNER = Format(2)
"""A planner's folder: planner.json and roadmaps."""
LEARNED = Format(2)
"""The learned method's folder: learned.json and arrays."""
PATH_DIFFUSION = Format(1)
"""A diffusion model of paths: path_diffusion.json and weights."""
