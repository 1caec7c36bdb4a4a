"""Rigs that borrow from a prior: each gets a camera-prior.yaml beside its own rig.yaml, which stays as it is.

The verdict is the one that the rig's own pictures gave; what was borrowed is said in the file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.files import write_atomically
from calib.fleet.manifest import Manifest
from calib.fleet.prior import Group, Posterior, Prior, constants_of, fingerprint, posterior
from calib.fleet.store import Store
from calib.rig import Camera, CovarianceTable, Rig, read_rig, rig_text

__all__ = ["BORROWED", "Borrowing", "borrow", "borrowed_camera"]

BORROWED = "camera-prior.yaml"
_MOST_NAMED = 50


@dataclass(frozen=True)
class Borrowing:
    """What came of a prior.

    Attributes
    ----------
    borrowed : rigs that did. shrunk : median over them of sigma after over sigma before, by constant.
    refused : rigs that did not, with the reason; no more than fifty of `not_borrowed`.
    fleet : rigs behind the prior.
    """

    borrowed: int
    shrunk: dict[str, float]
    refused: tuple[tuple[str, str], ...]
    not_borrowed: int
    fleet: int

    def as_json(self) -> dict[str, Any]:
        """For the document."""
        return {
            "rigs_of_the_prior": self.fleet,
            "borrowed": self.borrowed,
            "sigma_after_over_before": self.shrunk,
            "not_borrowed": self.not_borrowed,
            "refused": [{"name": name, "why": why} for name, why in self.refused],
        }

    def sentences(self) -> list[str]:
        """For people."""
        whole = self.borrowed + self.not_borrowed
        out = [
            f"{self.borrowed} of {whole} rigs borrowed from a prior of {self.fleet} rigs: {BORROWED} beside "
            "rig.yaml; verdicts are those without it"
        ]
        out += [f"{name} did not borrow: {why}" for name, why in self.refused[:5]]
        return out


def borrowed_camera(camera: Camera, group: Group, found: Posterior) -> Camera:
    """A camera with what it has after borrowing; what its own fit said of it stays, and it says so."""
    values = dict(zip(group.order, found.mean.tolist(), strict=True))
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    lens = {name: value for name, value in values.items() if name in type(camera.distortion).model_fields}
    others = {name: value for name, value in values.items() if name not in lens}
    remark = (
        f"Borrowed: these constants are shrunk to the distribution of {group.rigs} rigs of a fleet "
        "(empirical Bayes) and are not those of this rig's pictures alone; RMS, verdict and reasons are of "
        "the fit without it."
    )
    return camera.model_copy(
        update={
            **others,
            "distortion": camera.distortion.model_copy(update=lens),
            "sigma": {**camera.sigma, **dict(zip(group.order, sigma.tolist(), strict=True))},
            "covariance": CovarianceTable(order=list(group.order), values=found.covariance.tolist()),
            "projection_sigma_px": {},
            "remarks": [*camera.remarks, remark],
        }
    )


def borrow(store: Store, manifest: Manifest, prior: Prior) -> Borrowing:
    """Write a `BORROWED` for each rig that may have one, and remove one that it may not have any more."""
    refused: list[tuple[str, str]] = []
    ratios: dict[str, list[float]] = {}
    borrowed = not_borrowed = 0
    for spec in manifest.rigs:
        why = _borrow(store, spec.name, prior, ratios)
        if not why:
            borrowed += 1
            continue
        not_borrowed += 1
        store.result(spec.name, BORROWED).unlink(missing_ok=True)
        if len(refused) < _MOST_NAMED:
            refused.append((spec.name, why))
    shrunk = {name: float(np.median(values)) for name, values in ratios.items()}
    rigs = sum(group.rigs for group in prior.groups.values())
    return Borrowing(borrowed, shrunk, tuple(refused), not_borrowed, rigs)


def _borrow(store: Store, name: str, prior: Prior, ratios: dict[str, list[float]]) -> str:
    """Why a rig does not borrow, "" when it has."""
    outcome = store.outcome(name)
    if outcome is None or "rig.yaml" not in outcome.files:
        return "it has no result"
    rig = read_rig(store.result(name, "rig.yaml"))
    if rig.camera is None:
        return "it has no camera"
    if fingerprint(rig) in prior.members:
        return "it is itself one of the prior's rigs"
    found = constants_of(rig.camera)
    if found is None:
        return "its camera has no covariance"
    kind, x, V = found
    group = prior.groups.get(kind)
    if group is None:
        size = "x".join(str(side) for side in kind[1])
        return f"the prior has no rigs enough with {kind[0]} and pictures of {size} px"
    after = posterior(group, x, V)
    if not after.belongs:
        return f"it is not like the prior's rigs (a chance of {after.chance:.1e})"
    camera = borrowed_camera(rig.camera, group, after)
    inputs = {"camera": {**rig.provenance.inputs.get("camera", {}), "fleet prior": prior.digest}}
    provenance = rig.provenance.model_copy(update={"inputs": inputs})
    text = rig_text(Rig(geometry=rig.geometry, camera=camera, provenance=provenance))
    write_atomically(store.result(name, BORROWED), text)
    for i, constant in enumerate(group.order):
        if V[i, i] > 0.0:
            ratios.setdefault(constant, []).append(
                math.sqrt(max(float(after.covariance[i, i]), 0.0) / float(V[i, i]))
            )
    return ""
