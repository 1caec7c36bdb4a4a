"""Results: the class that a stage's `solve` returns is the section of rig.yaml.

A field says once what it is: its label and digits in `quantity`, its unit by the end of its key, its range
by its type. Terminal, page, JSON, notebook and manual are made from that (`calib.core.words`). Standard
deviations stand under `sigma` by key, the verdict beside them. Arrays that figures are drawn from ride
along as `evidence` and are not written.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, Any, Self

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from calib.core.errors import BadInputError
from calib.core.files import quoted, sha256
from calib.core.schema import contradiction
from calib.core.verdict import Finding, Verdict, Word

if TYPE_CHECKING:
    from calib.core.words import Block

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
Sigma = dict[str, NotNegative | None]
"""Standard deviations by key; null where the data do not bound one."""


def quantity(
    default: Any = ...,
    *,
    label: str,
    show: str = "",
    digits: int | None = None,
    digits_by: str = "",
    fact: bool | tuple[str | int, ...] = False,
    **limits: Any,
) -> Any:
    """A field of a section that a person reads.

    Parameters
    ----------
    label : words for terminal, page and manual.
    show : unit to show it in, where that is not the unit of the file ("ms" of a time, "deg" of an angle).
    digits : digits behind the point where there is no standard deviation to say how many.
    digits_by : key beside it with the standard deviation that says how many, in a table of parts.
    fact : whether it stands at the head of its stage on the page; of a list or mapping which items do.
    limits : `ge`, `gt`, `le`, `lt` as in pydantic.
    """
    shown = list(fact) if isinstance(fact, tuple) else fact
    extra: dict[str, Any] = {"show": show, "digits": digits, "digits_by": digits_by, "fact": shown}
    return Field(default, title=label, json_schema_extra=extra, **limits)


_ROUNDED = 1e-5
"""Part of a covariance that rounding and a least-squares solution may take away."""
_NOTHING = 1e-18
"""A covariance with a value that is fixed."""


class Section(BaseModel):
    """A section of rig.yaml or a part of one: keys that it does not know are refused."""

    model_config = ConfigDict(extra="forbid", defer_build=True)


class Statement(Section):
    """A part of rig.yaml that a person writes: what is not set is not written."""

    @model_serializer(mode="wrap")
    def _set_alone(self, whole: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = whole(self)
        chosen = self.model_fields_set
        return {key: one for key, one in values.items() if key in chosen and one is not None and one != {}}


class CovarianceTable(Section):
    """A covariance matrix with the names of its rows."""

    order: list[str]
    values: list[list[Number]]

    @model_validator(mode="after")
    def _of_variances(self) -> CovarianceTable:
        order, values = self.order, self.values
        if len(values) != len(order) or any(len(row) != len(order) for row in values):
            raise contradiction(f"values: expected {len(order)} rows and columns, as many as names in order")
        twice = next((name for name in order if order.count(name) > 1), None)
        if twice is not None:
            raise contradiction(f"order names {quoted(twice)} twice")
        for i, name in enumerate(order):
            if values[i][i] < 0.0:
                raise contradiction(f"values.{i}.{i} is {values[i][i]:g}, expected a variance of {name}")
        for i, j in combinations(range(len(order)), 2):
            most = math.sqrt(values[i][i]) * math.sqrt(values[j][j])
            if abs(values[i][j] - values[j][i]) > _ROUNDED * max(most, abs(values[i][j])):
                raise contradiction(
                    f"values.{i}.{j} is {values[i][j]:g} and values.{j}.{i} {values[j][i]:g}, expected one "
                    f"covariance of {order[i]} and {order[j]}"
                )
            if abs(values[i][j]) > (1.0 + _ROUNDED) * most + _NOTHING:
                raise contradiction(
                    f"values.{i}.{j} is {values[i][j]:g}, expected at most {most:g} in size by the variances "
                    f"of {order[i]} and {order[j]}"
                )
        if len(order) > 2 and self._least_eigenvalue() < -_ROUNDED:
            raise contradiction(
                "values is not positive semidefinite, so that no errors have these covariances"
            )
        return self

    def _least_eigenvalue(self) -> float:
        """Of the correlations."""
        import numpy as np

        values = np.array(self.values)
        scale = np.sqrt(np.diag(values))
        scale = np.where(scale > 0.0, scale, 1.0)
        return float(np.linalg.eigvalsh(values / scale / scale[:, None])[0])


class Result(Section):
    """A section that a stage has computed, with its verdict.

    In the file the verdict is four keys: `verdict`, its word, and the sentences `reasons`, `remarks` and
    `advice`. In Python `verdict` is a `Verdict`; a result is made with the keys of `judged`.
    """

    model_config = ConfigDict(serialize_by_alias=True)

    word_: Word = Field(alias="verdict")
    reasons_: list[str] = Field(default=[], alias="reasons")
    remarks_: list[str] = Field(default=[], alias="remarks")
    advice_: list[str] = Field(default=[], alias="advice")

    _evidence: Any = PrivateAttr(default=None)
    _inputs: dict[str, str] = PrivateAttr(default_factory=dict)
    _stage: str = PrivateAttr(default="")
    _seal: str = PrivateAttr(default="")

    @property
    def verdict(self) -> Verdict:
        """Whether the result can be trusted."""
        return Verdict.stored(self.word_, self.reasons_, self.remarks_, self.advice_)

    @property
    def evidence(self) -> Any:
        """What the result was made from: fits, residuals, curves; not in the file.

        Raises `BadInputError` for a section that was read from a file.
        """
        if self._evidence is None:
            name = type(self).__name__
            raise BadInputError(f"this {name} was read from a file, which holds no data for figures")
        return self._evidence

    @property
    def inputs(self) -> dict[str, str]:
        """SHA-256 of each input by its name; empty for a section that was read from a file."""
        return self._inputs

    def with_evidence(self, evidence: Any) -> Self:
        """The same result with what it was made from."""
        self._evidence = evidence
        return self

    @property
    def stage(self) -> str:
        """Words of the verb that made it; empty for a section that was read from a file."""
        return self._stage

    def made_by(self, stage: str, inputs: Mapping[str, str]) -> Self:
        """The same result with the stage that made it and the hashes of its inputs."""
        self._stage, self._inputs = stage, dict(inputs)
        return self

    def doubt(self, sentences: Iterable[str]) -> None:
        """Make the verdict poor, if it is better, for what the result was computed from."""
        new = [text for text in sentences if text not in self.reasons_]
        if new:
            self.word_ = "poor" if self.word_ == "ok" else self.word_
            self.reasons_ = [*self.reasons_, *new]

    def find(self, finding: Finding) -> None:
        """Add what is found only once the result is there."""
        if finding.severity == "remark":
            self.remarks_ = [*self.remarks_, finding.text]
        else:
            self.doubt([finding.text])
        self.advice_ = [*self.advice_, *([finding.advice] if finding.advice else [])]

    def sealed(self, written: str = "") -> str:
        """SHA-256 of the values that its verb wrote: `written` if given, else of those at the first call."""
        self._seal = written or self._seal or identity(self)
        return self._seal

    @property
    def changed(self) -> bool:
        """Whether the values are others than those that its verb wrote, as far as that is known."""
        return bool(self._seal) and self._seal != identity(self)

    def __eq__(self, other: object) -> bool:
        """Whether both say the same in a file; what figures are drawn from is left out."""
        return type(other) is type(self) and section_json(self) == section_json(other)

    __hash__ = None  # type: ignore[assignment]  # its fields can change

    def more_words(self) -> Sequence[Block]:
        """Tables between the quantities and the verdict that no field makes by itself."""
        return ()

    def _repr_html_(self) -> str:
        from calib.core.words import as_html, described

        return as_html(described(self))

    def __str__(self) -> str:
        from calib.core.words import as_text, described

        return "\n".join(as_text(described(self)))

    def __repr__(self) -> str:
        """The words of `str`: what a person sees who types a result's name."""
        return str(self)


def judged(verdict: Verdict) -> dict[str, Any]:
    """The keys of a verdict, to make a `Result` with: `Camera(..., **judged(verdict))`."""
    return {
        "verdict": verdict.word,
        "reasons": verdict.reasons,
        "remarks": verdict.remarks,
        "advice": verdict.advice,
    }


_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
"""Writes the same text; the C library does it in a twentieth of the time."""
OF_VERDICT = ("verdict", "reasons", "remarks", "advice")
"""Keys of a section that tell its verdict, the last in the file."""
_UNWRITTEN = ("rejected", "remarks", "advice")
"""Lists that are not written where they are empty."""


def section_json(section: BaseModel, whole: bool = False) -> dict[str, Any]:
    """A section as plain values in the order of the file, the verdict last.

    Unset and empty parts are left out, unless the `whole` is asked for.
    """
    values = section.model_dump(mode="json", by_alias=True)
    ordered = {key: values[key] for key in values if key not in OF_VERDICT}
    ordered |= {key: values[key] for key in OF_VERDICT if key in values}
    if whole:
        return ordered
    return {
        key: value
        for key, value in ordered.items()
        if value is not None and value != {} and not (key in _UNWRITTEN and value == [])
    }


def identity(section: BaseModel) -> str:
    """SHA-256 of a section's values, to tell later whether something was computed from them."""
    return sha256(yaml.dump(section_json(section), Dumper=_DUMPER, sort_keys=True).encode())


def finite_or_none(value: float) -> float | None:
    """A standard deviation for the file: null where the data do not bound it."""
    return float(value) if math.isfinite(value) else None


def degrees_or_none(value_rad: float) -> float | None:
    """The same of an angle, in degrees."""
    return finite_or_none(math.degrees(value_rad))
