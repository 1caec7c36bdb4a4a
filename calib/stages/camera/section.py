"""The sections `camera`, `plane` and `lens` of rig.yaml."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from calib.core.errors import UsageError
from calib.core.files import quoted
from calib.core.result import (
    Count,
    CovarianceTable,
    Matrix3,
    NotNegative,
    Number,
    Result,
    Section,
    Sigma,
    quantity,
)
from calib.core.schema import contradiction
from calib.core.words import nearest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from calib.core.arrays import FloatArray
    from calib.stages.camera import model as optics

Model = Annotated[str, Field(pattern="^(pinhole|radial2|radial3|fisheye4|brown5|rational8)$")]
Focal = Annotated[Number, Field(ge=1e-3, le=1e7)]
Pixels = Annotated[Number, Field(ge=-1e6, le=1e6)]
Coefficient = Annotated[Number, Field(ge=-1e30, le=1e30)]
Metres = Annotated[Number, Field(ge=-1e3, le=1e3)]
Side = Annotated[int, Field(ge=1, le=100_000, strict=True)]


class Distortion(Section):
    """Coefficients of `calib.stages.camera.model`; absent ones are zero."""

    k1: Coefficient = 0.0
    k2: Coefficient = 0.0
    p1: Coefficient = 0.0
    p2: Coefficient = 0.0
    k3: Coefficient = 0.0
    k4: Coefficient = 0.0
    k5: Coefficient = 0.0
    k6: Coefficient = 0.0


class Camera(Result):
    """Intrinsics, what they are worth, and why."""

    model: Model = quantity(label="model", fact=True)
    image_size_px: Annotated[list[Side], Field(min_length=2, max_length=2)] = quantity(label="picture")
    fx_px: Focal = quantity(label="focal length fx", digits=3, fact=True)
    fy_px: Focal = quantity(label="focal length fy", digits=3)
    skew_px: Pixels = quantity(0.0, label="skew", digits=3)
    cx_px: Pixels = quantity(label="centre cx", digits=3)
    cy_px: Pixels = quantity(label="centre cy", digits=3)
    distortion: Distortion = quantity(Distortion(), label="distortion", digits=5)
    sigma: Sigma = {}
    covariance: CovarianceTable | None = None
    rms_px: NotNegative | None = quantity(None, label="RMS", digits=4, fact=True)
    mean_error_px: NotNegative | None = quantity(None, label="mean error", digits=4)
    projection_sigma_px: Sigma = quantity({}, label="projection sigma", digits=3, fact=("max",))
    views: Count = quantity(0, label="views", fact=True)
    points: Count = quantity(0, label="points")
    board: str | None = quantity(None, label="board")
    loss: str | None = None
    termination: str | None = None
    rejected: list[str] = []
    simulated: bool = False

    @property
    def optics(self) -> optics.Camera:
        """The camera as the equations take it."""
        import numpy as np

        from calib.stages.camera.model import COEFFICIENTS, INTRINSICS, camera_from_vector

        width, height = self.image_size_px
        five = [getattr(self, name) for name in INTRINSICS[:5]]
        coefficients = [getattr(self.distortion, name) for name in COEFFICIENTS]
        return camera_from_vector(self.model, (width, height), np.array(five + coefficients))

    @property
    def intrinsic_covariance(self) -> FloatArray | None:
        """Covariance (13, 13) in the order of `model.INTRINSICS`, None where it is not known."""
        if self.covariance is None or not self.covariance.order:
            return None
        import numpy as np

        from calib.stages.camera.model import INTRINSICS

        index = [INTRINSICS.index(name) for name in self.covariance.order]
        whole = np.zeros((len(INTRINSICS), len(INTRINSICS)))
        whole[np.ix_(index, index)] = np.array(self.covariance.values)
        return whole

    @model_validator(mode="after")
    def _coefficients_of_the_model(self) -> Self:
        from calib.stages.camera.model import MODELS

        for name, value in self.distortion:
            if value != 0.0 and name not in MODELS[self.model]:
                raise contradiction(f"distortion.{name} is {value:g}, but {self.model} has no {name}")
        return self

    @field_validator("covariance")
    @classmethod
    def _of_intrinsics(cls, table: CovarianceTable | None) -> CovarianceTable | None:
        from calib.stages.camera.model import INTRINSICS

        order = [] if table is None else table.order
        wrong = next((name for name in order if name not in INTRINSICS), None)
        if wrong is not None:
            raise contradiction(
                f"order has {quoted(wrong)}, which is no intrinsic{nearest(wrong, INTRINSICS)}"
            )
        return table

    @property
    def K(self) -> FloatArray:
        """Intrinsic matrix (2.5), (3, 3), pixels."""
        return self.optics.K

    def project(self, points_m: ArrayLike) -> FloatArray:
        """Pixels (n, 2), lens and all, of points (n, 3) in the camera's frame in metres.

        NaN for points that the lens cannot see: behind a pinhole camera.
        """
        import numpy as np

        from calib.core.arrays import points_of
        from calib.stages.camera.model import project

        camera, points = self.optics, points_of(points_m, 3)
        behind = (points[:, 2] <= 0.0) & (not camera.fisheye)
        return project(camera, np.where(behind[:, None], np.nan, points))

    def undistort(self, pixels: ArrayLike) -> FloatArray:
        """Pixels (n, 2) where a pinhole camera with the same intrinsics would have seen them."""
        from calib.core.arrays import points_of
        from calib.stages.camera.model import undistort

        camera = self.optics
        plain = undistort(camera, points_of(pixels, 2))
        return plain @ camera.K[:2, :2].T + camera.K[:2, 2]


class Plane(Result):
    """The actuator's plane seen by the camera: A maps world metres to pixels (2.9 with K)."""

    R_CW: Matrix3
    t_CW_m: Annotated[list[Metres], Field(min_length=3, max_length=3)] = quantity(label="camera to plane")
    A_px_per_m: Matrix3
    A_inverse: Matrix3
    sigma: Sigma = {}
    rms_px: NotNegative = quantity(label="RMS", digits=4)
    rms_mm: NotNegative = quantity(label="RMS on the plane", digits=4, fact=True)
    sigma_marker_mm: Sigma = quantity(
        {}, label="sigma of a marker", digits=4, fact=("calibration_max", "quantisation_max")
    )
    without_intrinsics: dict[str, Number] = quantity({}, label="homography alone", digits=4)
    pictures: Count = quantity(0, label="pictures")
    points: Count = quantity(0, label="points")
    orientation: str = quantity("", label="orientation")
    simulated: bool = False

    @model_validator(mode="after")
    def _a_pose_and_its_homography(self) -> Self:
        import numpy as np

        R, A, A_inverse = np.array(self.R_CW), np.array(self.A_px_per_m), np.array(self.A_inverse)
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise contradiction("R_CW is not a rotation")
        if not any(self.t_CW_m):
            raise contradiction("t_CW_m is zero, expected the way from camera to plane")
        if not np.allclose(A_inverse @ A, np.eye(3), atol=1e-6):
            raise contradiction("A_inverse is not the inverse of A_px_per_m")
        return self

    def off_px(self, camera: Camera, workspace_m: Sequence[float]) -> float:
        """By how much A_px_per_m and K [r1 r2 t] differ at the corners x0, y0, x1, y1 of a workspace."""
        import numpy as np

        x0, y0, x1, y1 = workspace_m
        corners = np.array([[x0, y0, 1.0], [x1, y0, 1.0], [x0, y1, 1.0], [x1, y1, 1.0]])
        of_pose = camera.optics.K @ np.column_stack([np.array(self.R_CW)[:, :2], self.t_CW_m])
        one, other = corners @ np.array(self.A_px_per_m).T, corners @ of_pose.T
        return float(np.abs(one[:, :2] / one[:, 2:] - other[:, :2] / other[:, 2:]).max())

    def to_pixels(self, world_m: ArrayLike, camera: Camera) -> FloatArray:
        """Pixels (n, 2), lens and all, at which the camera sees places on the plane (n, 2) in metres."""
        import numpy as np

        from calib.core.arrays import points_of
        from calib.stages.camera.model import project

        points = points_of(world_m, 2) @ np.array(self.R_CW)[:, :2].T + np.array(self.t_CW_m)
        return project(camera.optics, points)

    def to_world(self, pixels: ArrayLike, camera: Camera | None = None) -> FloatArray:
        """Places on the plane (n, 2) in metres of pixels (n, 2).

        Parameters
        ----------
        camera : undoes the lens; without it the pixels are those of a pinhole camera.
        """
        import numpy as np

        from calib.core.arrays import points_of
        from calib.core.geometry import apply_homography

        if not isinstance(camera, Camera | None):
            raise UsageError(f"camera is of type {type(camera).__name__}, expected one as rig.camera")
        ideal = points_of(pixels, 2) if camera is None else camera.undistort(pixels)
        return apply_homography(np.array(self.A_inverse), ideal)


class InverseLens(Section):
    """The polynomial of `calib.stages.camera.lens`."""

    radial: list[Number]
    decentering_steps: Count
    max_error_px: NotNegative | None
    covered: Number = Field(ge=0, le=1)


class Lens(Result):
    """What lens distortion does over the picture and costs on the plane.

    That a lens matters is no defect: `effect` says it, and the verdict stays ok.
    """

    kind: str = quantity(label="kind of distortion", fact=True)
    max_px: Number = quantity(label="distortion, at most", digits=3, fact=True)
    mean_px: Number = quantity(label="distortion, mean", digits=3)
    region_px: Annotated[list[Number], Field(min_length=4, max_length=4)]
    region_max_px: Number = quantity(label="in the region, at most", digits=3)
    region_mean_px: Number = quantity(label="in the region, mean", digits=3)
    region_sigma_px: Number | None = quantity(None, label="sigma in the region", digits=3)
    monotonic: bool = quantity(label="one-to-one")
    plane_max_mm: Number | None = quantity(None, label="neglected, on the plane at most", digits=3, fact=True)
    plane_mean_mm: Number | None = quantity(None, label="neglected, on the plane on average", digits=3)
    refitted_max_mm: Number | None = quantity(None, label="with the plane refitted, at most", digits=3)
    refitted_mean_mm: Number | None = quantity(None, label="with the plane refitted, on average", digits=3)
    inverse: InverseLens
    effect: Literal["negligible", "matters"] = quantity(label="effect", fact=True)

    @model_validator(mode="before")
    @classmethod
    def _of_schema_1(cls, values: Any) -> Any:
        """Files of schema 1 hold the effect as the verdict."""
        if isinstance(values, dict) and values.get("verdict") in ("negligible", "matters"):
            later = {**values, "effect": values["verdict"], "verdict": "ok"}
            return {**later, "remarks": later.pop("reasons", [])}
        return values
