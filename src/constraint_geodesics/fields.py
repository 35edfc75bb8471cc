"""Numbers and names as params.yaml may hold them, checked by Pydantic."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from constraint_geodesics.values import LARGEST, MOST_ANGLE

Positive = Annotated[float, Field(gt=0, le=LARGEST, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, lt=1)]
Rate = Annotated[float, Field(gt=0, le=1)]
Count = Annotated[int, Field(ge=1, le=int(LARGEST))]
Rows = Annotated[int, Field(ge=1, le=10**8)]
"""Of a set that is held in memory."""
Width = Annotated[int, Field(ge=1, le=2**16)]
"""Of a network's layer."""
Few = Annotated[int, Field(ge=2, le=10_000)]
"""Steps, segments or points along something: one more costs as much again."""
Points = Annotated[int, Field(ge=10, le=10**6)]
"""Of a graph, or of something else that has a matrix or a search."""
Degree = Annotated[int, Field(ge=4, le=256, multiple_of=4)]
"""Of the polynomials that lengths are measured with."""
ChartDim = Annotated[int, Field(ge=1, le=64)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]


def _different(seeds: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(seeds)) < len(seeds):
        raise ValueError("must differ from each other")
    return seeds


Seeds = Annotated[tuple[Seed, ...], Field(min_length=1), AfterValidator(_different)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
Vector3 = tuple[Finite, Finite, Finite]


def _no_degrees(angle: float) -> float:
    if abs(angle) > MOST_ANGLE:
        raise ValueError(f"{angle:g}: must be within ±4π: angles are in rad, not degrees")
    return angle


Angle = Annotated[Finite, AfterValidator(_no_degrees)]
Angles3 = tuple[Angle, Angle, Angle]
"""Roll, pitch and yaw."""


def _no_flag(value: Any) -> Any:
    if isinstance(value, bool):  # which equals one of them
        raise ValueError(f"{value}: must be 0 or 1")
    return value


Bit = Annotated[Literal[0, 1], BeforeValidator(_no_flag)]
