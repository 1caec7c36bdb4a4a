"""After all rigs: the table with what stands out, and cameras that borrow from an earlier fleet."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from calib.core.files import sha256
from calib.core.result import CovarianceTable
from calib.core.rig import Provenance, Rig, read_rig, rig_text
from calib.runner.finishing import finish
from calib.runner.fleet import BORROWED, Store, Table, column, opened_store, read_prior, texts
from calib.runner.task import Answer, Manifest, Outcome, RigSpec
from calib.stages.camera.section import Camera, Distortion

pytest.importorskip("pyarrow")

_ORDER = ["fx_px", "fy_px", "k1"]
_SIGMA = np.array([0.8, 0.8, 0.004])


def _rig(rng: np.random.Generator, name: str, fx_px: float | None = None, verdict: str = "ok") -> Rig:
    """A camera whose focal length differs from rig to rig less than its own sigma."""
    true = 273.0 + 0.3 * rng.standard_normal() if fx_px is None else fx_px
    x = np.array([true, true, -0.22 + 0.001 * rng.standard_normal()]) + _SIGMA * rng.standard_normal(3)
    camera = Camera(
        model="radial2",
        image_size_px=[316, 208],
        fx_px=float(x[0]),
        fy_px=float(x[1]),
        cx_px=160.0,
        cy_px=102.0,
        distortion=Distortion(k1=float(x[2])),
        sigma=dict(zip(_ORDER, _SIGMA.tolist(), strict=True)),
        covariance=CovarianceTable(order=_ORDER, values=np.diag(_SIGMA**2).tolist()),
        rms_px=0.1,
        verdict=verdict,
        reasons=[] if verdict == "ok" else ["The board was seen from one side only."],
    )
    return Rig(camera=camera, provenance=Provenance(inputs={"camera": {"a.png": sha256(name.encode())}}))


@contextmanager
def _fleet(out: Path, rigs: dict[str, Rig]) -> Iterator[tuple[Store, Manifest]]:
    from calib.runner.task import _values

    with opened_store(out, "calib fleet", ()) as (store, _):
        for name, rig in rigs.items():
            text = rig_text(rig).encode()
            assert rig.camera is not None
            scratch = out / "one.yaml"
            scratch.write_bytes(text)
            poor = not rig.camera.verdict.ok
            outcome = Outcome(
                name, "", "", "poor" if poor else "ok", int(poor), key="k", values=_values(scratch),
                files={"rig.yaml": sha256(text)},
            )  # fmt: skip
            scratch.unlink()
            store.keep(Answer(outcome, {"rig.yaml": text}))
        yield store, Manifest(tuple(RigSpec(name, "/x") for name in rigs), ())


def _many(seed: int, count: int) -> dict[str, Rig]:
    rng = np.random.default_rng(seed)
    return {f"rig{seed}-{k}": _rig(rng, f"{seed}-{k}") for k in range(count)}


def test_who_stands_out_is_a_row_that_says_so(tmp_path: Path) -> None:
    rigs = _many(0, 30)
    rigs["far"] = _rig(np.random.default_rng(9), "far", fx_px=290.0)
    with _fleet(tmp_path, rigs) as (store, manifest):
        summary, told = finish(store, manifest)
    assert told is None and summary.rigs == 31
    assert [look.name for look in summary.looks] == ["far"]
    with Table(tmp_path / "fleet.parquet") as table:
        assert table.rows == 31
        of, out = texts(table, "outlier_of"), table.read("stands_out").to_pylist()
        assert [name for name, one in zip(texts(table, "name"), out, strict=True) if one] == ["far"]
        assert of[-1] in ("camera.fx_px", "camera.fy_px") and column(table, "outlier_z")[-1] > 5.0
    assert not list((tmp_path / ".fleet").glob("*.parquet"))


def test_new_rigs_borrow_and_say_so(tmp_path: Path) -> None:
    old = _many(0, 40)
    with _fleet(tmp_path / "old", old) as (store, manifest):
        finish(store, manifest)
    prior = read_prior(tmp_path / "old")
    (group,) = prior.groups.values()
    assert group.rigs == 40 and group.order == tuple(_ORDER)
    rng = np.random.default_rng(5)
    new = {f"new{k}": _rig(rng, f"new{k}") for k in range(6)}
    new["weak"] = _rig(rng, "weak", verdict="poor")
    new["strange"] = _rig(rng, "strange", fx_px=300.0)
    new["again"] = old["rig0-3"]
    with _fleet(tmp_path / "new", new) as (store, manifest):
        own = {name: store.result(name, "rig.yaml").read_bytes() for name in new}
        _, told = finish(store, manifest, prior)
        assert {name: store.result(name, "rig.yaml").read_bytes() for name in new} == own
    assert told is not None and (told.borrowed, told.not_borrowed) == (7, 2)
    refused = dict(told.refused)
    assert "not like the prior's rigs" in refused["strange"]
    assert "itself one of the prior's rigs" in refused["again"]
    assert not (tmp_path / "new/rigs/strange" / BORROWED).exists()
    assert all(0.2 < ratio < 0.95 for ratio in told.shrunk.values())
    before, after = (read_rig(tmp_path / "new/rigs/new0" / name) for name in ("rig.yaml", BORROWED))
    assert before.camera is not None and after.camera is not None
    assert after.camera.sigma["fx_px"] < before.camera.sigma["fx_px"]
    assert any(remark.startswith("Borrowed: ") for remark in after.camera.verdict.remarks)
    assert after.provenance.inputs["camera"]["fleet prior"] == prior.digest
    weak = read_rig(tmp_path / "new/rigs/weak" / BORROWED).camera
    assert weak is not None and weak.verdict.word == "poor" and weak.verdict.reasons
    assert any("7 of 9 rigs borrowed" in sentence for sentence in told.sentences())
    # A prior that the rig may not use any more takes its file away.
    with _fleet(tmp_path / "new", {"new0": _rig(rng, "x", fx_px=300.0)}) as (store, manifest):
        finish(store, manifest, prior)
        assert not store.result("new0", BORROWED).exists()
