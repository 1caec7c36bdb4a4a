"""What a fleet says of a rig that it has not seen: the distribution of its cameras, and what a rig borrows.

The constants of rig i are theta_i ~ N(mu, T), its calibration gives x_i ~ N(theta_i, V_i). By the method of
moments T = S - mean(V_i), with S the covariance of the x_i over the rigs, made positive semi-definite in the
coordinates in which mean(V_i) is the identity; then mu by generalised least squares, C = (sum W_i)^-1 and
W_i = (T + V_i)^-1 (DerSimonian and Laird 1986, for vectors Jackson, White and Thompson 2010). A new rig with
x and V has, with P = T + D + C,

    theta | x ~ N(mu + G (x - mu), P - G P),    G = P (P + V)^-1

(Carlin and Louis 2000, 3.3). D is two standard errors of T, 2 lambda_j sqrt(2 / (n - 1)) for the eigenvalue
lambda_j of S in those coordinates: a T that came out too small would make rigs too sure of themselves (by
simulation the mean of e' Cov^-1 e is then 2.9 of 3 with 20 rigs, 2.7 with 200). A group needs more than two
rigs for each constant. A rig for which (x - mu)' (P + V)^-1 (x - mu) is larger than chance is not one of
this fleet, and does not borrow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.files import sha256, shown
from calib.fleet.rows import Table, texts
from calib.rig import Camera, Rig, read_rig

__all__ = [
    "Group",
    "Posterior",
    "Prior",
    "constants_of",
    "fingerprint",
    "group_of",
    "posterior",
    "read_prior",
]

_BESIDE = 2
_SURE = 2.0
_CHANCE = 1e-3


@dataclass(frozen=True)
class Group:
    """Cameras of one lens model and picture size.

    Attributes
    ----------
    order : names of the k constants. mean : mu (k,). rigs : how many.
    between, slack, of_mean : T, D and C, each (k, k).
    """

    order: tuple[str, ...]
    mean: FloatArray
    between: FloatArray
    slack: FloatArray
    of_mean: FloatArray
    rigs: int


@dataclass(frozen=True)
class Posterior:
    """What a rig has after borrowing.

    Attributes
    ----------
    mean, covariance : (k,) and (k, k). chance : of a rig of this fleet to lie as far off or farther.
    """

    mean: FloatArray
    covariance: FloatArray
    chance: float

    @property
    def belongs(self) -> bool:
        """Whether the rig may be one of the fleet."""
        return self.chance >= _CHANCE


Kind = tuple[str, tuple[int, ...], tuple[str, ...]]


@dataclass(frozen=True)
class Prior:
    """A fleet as a prior.

    Attributes
    ----------
    groups : by model, picture size and names of the constants. members : fingerprints of its rigs' inputs.
    digest : SHA-256 of all of it. remarks : on what could not be used.
    """

    groups: dict[Kind, Group]
    members: frozenset[str]
    digest: str
    remarks: tuple[str, ...]


def constants_of(camera: Camera) -> tuple[Kind, FloatArray, FloatArray] | None:
    """Kind of a camera, its constants (k,) and their covariance (k, k); None without a covariance."""
    known = camera.covariance
    if known is None or not known.order:
        return None
    values = {**camera.model_dump(), **camera.distortion.model_dump()}
    order = tuple(known.order)
    if any(not isinstance(values.get(name), float) for name in order):
        return None
    V = np.array(known.values, dtype=np.float64)
    x = np.array([values[name] for name in order], dtype=np.float64)
    return (camera.model, tuple(camera.image_size_px), order), x, 0.5 * (V + V.T)


def fingerprint(rig: Rig) -> str:
    """SHA-256 of the pictures that a rig's camera was calibrated from; two of the same are one rig."""
    inputs = rig.provenance.inputs.get("camera", {})
    return sha256("\n".join(sorted(inputs.values())).encode())


def group_of(order: tuple[str, ...], x: FloatArray, V: FloatArray) -> Group | None:
    """The distribution behind rigs with constants (n, k) and covariances (n, k, k), None for too few."""
    n, k = x.shape
    if n < _BESIDE * k + 2:
        return None
    S, usual = np.atleast_2d(np.cov(x, rowvar=False)), V.mean(axis=0)
    scale = np.sqrt(np.diag(usual))
    try:
        L = scale[:, None] * np.linalg.cholesky(usual / scale / scale[:, None])
    except np.linalg.LinAlgError:
        return None
    half = np.linalg.solve(L, np.linalg.solve(L, S).T)
    eigenvalues, Q = np.linalg.eigh(0.5 * (half + half.T))
    root = L @ Q
    T = (root * np.maximum(eigenvalues - 1.0, 0.0)) @ root.T
    D = (root * _SURE * np.maximum(eigenvalues, 0.0) * math.sqrt(2.0 / (n - 1))) @ root.T
    W = _inverse(T + V, scale)
    C = _inverse(W.sum(axis=0)[None] * scale * scale[:, None], np.ones(k))[0] * scale * scale[:, None]
    mu = C @ np.einsum("nij,nj->i", W, x)
    return Group(order, mu, T, D, 0.5 * (C + C.T), n)


def _inverse(A: FloatArray, scale: FloatArray) -> FloatArray:
    """Inverses of symmetric (n, k, k), constants of very different size brought to one first."""
    normal = A / scale / scale[:, None]
    return np.asarray(np.linalg.pinv(normal, hermitian=True) / scale / scale[:, None])


def posterior(group: Group, x: FloatArray, V: FloatArray) -> Posterior:
    """What follows for a rig with constants x (k,) and their covariance V (k, k)."""
    from scipy.special import chdtrc

    P = group.between + group.slack + group.of_mean
    scale = np.sqrt(np.diag(P + V))
    inverse = _inverse((P + V)[None], scale)[0]
    off = x - group.mean
    G = P @ inverse
    covariance = P - G @ P
    return Posterior(
        group.mean + G @ off,
        0.5 * (covariance + covariance.T),
        float(chdtrc(len(x), max(float(off @ inverse @ off), 0.0))),
    )


def read_prior(folder: Path) -> Prior:
    """The prior in the results of an earlier fleet: of its rigs that are ok and do not stand out.

    Raises `BadInputError` where there is no such fleet, or too few rigs of any kind.
    """
    path = folder / "fleet.parquet"
    if not path.is_file():
        raise BadInputError(f"{shown(folder)}: has no fleet.parquet, expected the results of calib fleet")
    try:
        with Table(path) as table:
            names, verdicts = texts(table, "name"), texts(table, "verdict")
            standing = table.read("stands_out").to_pylist()
    except (OSError, ValueError, KeyError) as error:
        raise BadInputError(f"{shown(path)}: is no table of a fleet: {error}") from error
    gathered: dict[Kind, list[tuple[FloatArray, FloatArray]]] = {}
    members: set[str] = set()
    for name, verdict, out in zip(names, verdicts, standing, strict=True):
        rig = read_rig(folder / "rigs" / name / "rig.yaml") if verdict in ("ok", "poor") else Rig()
        if rig.camera is None:
            continue
        members.add(fingerprint(rig))
        found = constants_of(rig.camera)
        if verdict == "ok" and rig.camera.verdict == "ok" and not out and found is not None:
            gathered.setdefault(found[0], []).append(found[1:])
    groups, remarks = {}, []
    for kind, rigs in gathered.items():
        made = group_of(kind[2], np.array([x for x, _ in rigs]), np.array([V for _, V in rigs]))
        if made is None:
            few = f"{len(rigs)} rigs with {kind[0]} are too few for {len(kind[2])} constants"
            remarks.append(f"{shown(folder)}: {few}; nothing is borrowed from them")
        else:
            groups[kind] = made
    if not groups:
        why = remarks[0] if remarks else f"{shown(folder)}: has no cameras that are ok"
        raise BadInputError(f"{why}; this fleet is no prior")
    digest = sha256("\n".join(sorted(members)).encode())
    return Prior(groups, frozenset(members), digest, tuple(remarks))
