"""Numbers and names as params.yaml may hold them, checked by Pydantic."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

LARGEST = 1e9
"""Of any number: beyond it squares and sums overflow, and nothing here is counted or measured."""
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
ChartDim = Annotated[int, Field(ge=1, le=64)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]


def _different(seeds: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(seeds)) < len(seeds):
        raise ValueError("must differ from each other")
    return seeds


Seeds = Annotated[tuple[Seed, ...], Field(min_length=1), AfterValidator(_different)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
Vector3 = tuple[Finite, Finite, Finite]
Bit = Literal[0, 1]
