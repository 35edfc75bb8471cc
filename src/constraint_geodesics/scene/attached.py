"""What an arm carries."""

from dataclasses import dataclass

from constraint_geodesics.scene.shape import Shape


@dataclass(frozen=True)
class Attached:
    """A shape that moves with a link of the robot, placed in that link's frame.

    touching: names of links, and of other shapes, that may touch it; its own link may.
    """

    shape: Shape
    link: str
    touching: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The shape's."""
        return self.shape.name
