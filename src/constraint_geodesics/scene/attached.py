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


def is_unchanged(one: Shape | Attached, before: Shape | Attached) -> bool:
    """Whether a shape, attached or not, is what it was.  One that reads files is if it is the very
    same object: an equal one may have been made since its file was written anew.
    """
    if one is before:
        return True
    own, known = (x.shape if isinstance(x, Attached) else x for x in (one, before))
    return one == before and (own is known or not own.reads_files)
