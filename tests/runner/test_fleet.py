"""Fleets and sweeps in this process: manifests, fetching, what is done, left alone and kept."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.core.files import sha256
from calib.core.result import CovarianceTable
from calib.core.rig import Provenance, Rig
from calib.core.workers import Failure, Task
from calib.core.writing import make_folder
from calib.runner.fleet import (
    FleetOptions,
    Manifest,
    RigSpec,
    finish,
    is_url,
    kind_of,
    read_manifest,
    reasons_of,
    run_fleet,
    run_stages,
    values_of,
    without_secrets,
)
from calib.runner.folder import read_folder
from calib.runner.graph import STEPS, Job
from calib.runner.outcomes import Answer, Outcome, Store, column, opened_store, texts
from calib.runner.processes import Here
from calib.stages.camera.section import Camera, Distortion


def test_failures_are_rows_and_what_is_there_is_left_alone(tmp_path: Path) -> None:
    specs = []
    for k in range(5):
        images = tmp_path / f"rig{k}" / "images"
        images.mkdir(parents=True)
        (images / "a.png").write_bytes(b"no picture %d" % k)
        (images / "day1").mkdir()
        specs.append(RigSpec(f"rig{k}", str(images.parent), str(k)))
    specs.append(RigSpec("gone", str(tmp_path / "none"), written="rigs/none"))
    manifest, said = Manifest(tuple(specs), ()), list[str]()
    with opened_store(tmp_path / "out", "calib fleet", ()) as (store, _):
        first = run_fleet(store, Here(), manifest, FleetOptions(), tell=said.append)
        assert first == {"failed": 6}
        # Tables and page do not say where the fleet lies.
        assert any(one.startswith("gone: failed (rigs/none: is not") for one in said) and len(said) == 11
        assert "rig0: images/: day1 left out, folders are not looked into" in said
        found = store.outcome("rig2")
        assert found is not None and found.code == 3
        # Bad input is bad input again; a folder that was not there may be there now.
        (tmp_path / "rig1" / "images" / "a.png").write_bytes(b"another")
        # A rig that was renamed leaves its results behind.
        make_folder(tmp_path / "out" / "rigs" / "rig9")
        again = run_fleet(store, Here(), manifest, FleetOptions(), tell=said.append)
        assert again == {"same": 4, "failed": 2} and said[11].endswith("does not name: rig9")


def test_a_rig_that_failed_says_first_what_has_failed() -> None:
    ends = zip(STEPS, ("poor", "skipped", "failed", "ok", "blocked"), strict=False)
    ended = [Job(step.name, step, status=status, reason=status) for step, status in ends]
    assert [one.rpartition(": ")[2] for one in reasons_of(ended)] == ["failed", "poor", "blocked"]


class _Failing(Here):
    """Tasks fail in the way that their name says."""

    def finished(self) -> Iterator[tuple[Task, Any]]:
        for task, _ in super().finished():
            yield task, Failure(task.name, ValueError("why"))


def test_a_rig_without_an_answer_is_a_row(tmp_path: Path) -> None:
    manifest = Manifest(tuple(RigSpec(name, "/x") for name in ("died", "over", "raised")), ())
    with opened_store(tmp_path / "out", "calib fleet", ()) as (store, _):
        counts = run_fleet(store, _Failing(), manifest, FleetOptions(), limit_s=8.0)
        found = {name: store.outcome(name) for name in ("died", "over", "raised")}
    assert counts == {"lost": 2, "broken": 1}
    assert {name: (one.key, one.sentence) for name, one in found.items() if one is not None} == {
        "died": ("", "each process that tried it died: out of memory, or a fault in a library"),
        "over": ("", "was not done after 8 s, which is the --timeout of a rig"),
        "raised": ("", "internal error: ValueError: why; please report it (CALIB_DEBUG=1 shows more)"),
    }


def _csv(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "m.csv"
    path.write_text(text)
    return path


def test_csv_and_yaml_say_the_same(tmp_path: Path) -> None:
    from_csv = read_manifest(
        _csv(tmp_path, "name,path,serial,model,made by\na 1,rigs/a,AX-07,radial2,me\nb,s3://bucket/b,,,\n")
    )
    yaml = tmp_path / "m.yaml"
    yaml.write_text(
        "rigs:\n- {name: a 1, path: rigs/a, serial: AX-07, model: radial2, made by: me}\n"
        "- {name: b, path: 's3://bucket/b'}\n"
    )
    from_yaml = read_manifest(yaml)
    assert from_csv == from_yaml
    a, b = from_csv.rigs
    assert (
        a.source == str(tmp_path / "rigs/a") and a.options == (("model", "radial2"),) and a.serial == "AX-07"
    )
    assert b.source == "s3://bucket/b" and b.options == () and is_url(b.source) and not is_url(a.source)
    assert from_csv.ignored == ("made by",)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("name,folder\na,b\n", "m.csv: has no column path, found name, folder"),
        ("name,path\n../a,b\n", "line 2: name is '../a', expected a name without a dot"),
        ("name,path\na\\b,b\n", "expected a name of letters"),
        ("name,path\na,\n", "line 2: path is '', expected the rig's folder"),
        ("name,path\na,zip::s3://x\n", "expected a plain URL"),
        (f"name,path\n{'a' * 81},b\n", "expected a name of 1 to 80 bytes"),
    ],
)
def test_what_is_no_manifest_is_told_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(BadInputError) as error:
        read_manifest(_csv(tmp_path, text))
    assert said in str(error.value).replace("\\\\", "\\").replace("\\", "\\\\") or said in str(error.value)
    assert "\n" not in str(error.value)


@given(st.text(max_size=12))
def test_a_name_that_is_taken_is_a_safe_folder(name: str) -> None:
    from calib.runner.fleet import _named

    with contextlib.suppress(ValueError):
        path = Path("root") / _named(name)
        assert path.parent == Path("root") and path.name == name and name.isprintable()


def test_no_secret_is_kept() -> None:
    assert without_secrets("https://user:word@host:1/a/b?key=1") == "https://host:1/a/b"
    assert without_secrets("s3://bucket/a") == "s3://bucket/a"
    assert without_secrets("/data/a?b@c") == "/data/a?b@c"


def _verbs(tmp_path: Path, *commands: tuple[str, ...]) -> bytes:
    rig = tmp_path / "single.yaml"
    for words in commands:
        done = subprocess.run(
            [sys.executable, "-m", "calib", *words, "--rig", str(rig)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    return rig.read_bytes()


@pytest.mark.slow
def test_the_bytes_are_those_of_single_verbs(tmp_path: Path, project_root: Path) -> None:
    root = tmp_path / "rig"
    shutil.copytree(project_root / "images", root / "images")
    folder = read_folder(root)
    assert kind_of(folder) == "camera"
    ended = run_stages(folder, "camera", (("model", "radial2"),), tmp_path / "out")
    assert {job.status for job in ended.ended} == {"ok"}
    images = str(root / "images")
    single = _verbs(
        tmp_path,
        ("intrinsics", images, "--model", "radial2"),
        ("extrinsics", f"{images}/plane"),
        ("distortion",),
    )
    assert (ended.out / "rig.yaml").read_bytes() == single


def test_what_a_rig_folder_holds(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInputError, match="holds no pictures in images/ and no logs in logs/"):
        read_folder(tmp_path / "empty")
    logs = tmp_path / "with" / "logs"
    logs.mkdir(parents=True)
    (logs / "a.csv").write_text("t_s\n")
    assert kind_of(read_folder(tmp_path / "with")) == "run"
    flat = tmp_path / "flat"
    flat.mkdir()
    (tmp_path / "secret.png").write_bytes(b"x")
    (flat / "a.png").write_bytes(b"x")
    (flat / "b.png").symlink_to(tmp_path / "secret.png")
    assert [path.name for path in read_folder(flat).pictures] == ["a.png"]


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
    with opened_store(out, "calib fleet", ()) as (store, _):
        for name, rig in rigs.items():
            text = rig.text().encode()
            assert rig.camera is not None
            poor = not rig.camera.verdict.ok
            outcome = Outcome(
                name=name,
                status="poor" if poor else "ok",
                code=int(poor),
                key="k",
                values=values_of(rig),
                files={"rig.yaml": sha256(text)},
            )
            store.keep(Answer(outcome, {"rig.yaml": text}))
        yield store, Manifest(tuple(RigSpec(name, "/x") for name in rigs), ())


def _many(seed: int, count: int) -> dict[str, Rig]:
    rng = np.random.default_rng(seed)
    return {f"rig{seed}-{k}": _rig(rng, f"{seed}-{k}") for k in range(count)}


def test_what_the_data_do_not_determine_is_compared_with_nothing(tmp_path: Path) -> None:
    rigs = _many(0, 12)
    rigs["untold"] = _rig(np.random.default_rng(9), "untold", fx_px=9e6, verdict="unidentifiable")
    with _fleet(tmp_path, rigs) as (store, manifest):
        spread = next(one.spread for one in finish(store, manifest).constants if one.name == "camera.fx_px")
    assert (spread.count, spread.high < 300.0) == (12, True)


def test_who_stands_out_is_a_row_that_says_so(tmp_path: Path) -> None:
    rigs = _many(0, 30)
    rigs["far"] = _rig(np.random.default_rng(9), "far", fx_px=290.0)
    with _fleet(tmp_path, rigs) as (store, manifest):
        summary = finish(store, manifest)
    assert summary.rigs == 31
    assert [look.name for look in summary.looks] == ["far"]
    table = pyarrow.parquet.read_table(tmp_path / "fleet.parquet")
    assert table.num_rows == 31
    of, out = texts(table, "outlier_of"), table["stands_out"].to_pylist()
    assert [name for name, one in zip(texts(table, "name"), out, strict=True) if one] == ["far"]
    assert of[-1] in ("camera.fx_px", "camera.fy_px") and column(table, "outlier_z")[-1] > 5.0
