"""What the sections of rig.yaml are made of: kinds of numbers, short lists, covariance matrices."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

__all__ = [
    "Count",
    "CovarianceTable",
    "Matrix3",
    "NotNegative",
    "Number",
    "Pair",
    "PerAxis",
    "Positive",
    "Row3",
    "Section",
    "Sizes",
]

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=0, strict=True)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Row3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
Matrix3 = Annotated[list[Row3], Field(min_length=3, max_length=3)]
PerAxis = Annotated[list[Number | None], Field(min_length=3, max_length=3)]
"""x, y, z; null for what was not measured or cannot be told."""
Sizes = Annotated[list[NotNegative | None], Field(min_length=3, max_length=3)]
"""As `PerAxis`, of what is not negative."""


class Section(BaseModel):
    """A section or a part of one: keys that it does not know are refused."""

    model_config = ConfigDict(extra="forbid", defer_build=True)


class CovarianceTable(Section):
    """A covariance matrix with the names of its rows."""

    order: list[str]
    values: list[list[Number]]

    @model_validator(mode="after")
    def _square(self) -> CovarianceTable:
        if len(self.values) != len(self.order) or any(len(row) != len(self.order) for row in self.values):
            raise ValueError(f"expected {len(self.order)} rows and columns, as many as names in order")
        return self
