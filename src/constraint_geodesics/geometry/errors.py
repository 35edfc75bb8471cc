"""What geometry refuses: typed errors that name the array, the place and the value."""


class GeometryError(ValueError):
    """The input has no geometric meaning; the message names it, its value and what is allowed."""


class NonFiniteError(GeometryError):
    """An entry is NaN or infinite.

    what: name of the array.  index: place of the first such entry in it.  value: the entry.
    """

    def __init__(self, what: str, index: tuple[int, ...], value: float) -> None:
        # The bare arguments go to the base class because an exception is copied between processes
        # from them.
        super().__init__(what, index, value)
        self.what, self.index, self.value = what, index, value

    def __str__(self) -> str:
        place = ", ".join(str(i) for i in self.index)
        return f"{self.what}[{place}] = {self.value}: must be finite"


class OutsideError(GeometryError):
    """A point lies where the manifold isn't: beyond its grid, or in a blocked cell.

    what: name of the array.  index: place of the first such point in it.  point: its coordinates.
    """

    def __init__(self, what: str, index: tuple[int, ...], point: tuple[float, ...]) -> None:
        super().__init__(what, index, point)
        self.what, self.index, self.point = what, index, point

    def __str__(self) -> str:
        place = f"[{', '.join(str(i) for i in self.index)}]" if self.index else ""
        return (
            f"{self.what}{place} = {list(self.point)}: lies outside the manifold or in a "
            f"blocked cell"
        )


class StartVelocityError(GeometryError):
    """A motion can't go on along these rows from the velocity that it has: they turn away from it,
    or end before it can stop.
    """
