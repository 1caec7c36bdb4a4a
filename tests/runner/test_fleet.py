"""Fleets and sweeps in this process: manifests, fetching, what is done, left alone and kept."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path

import numpy as np
import pytest
from fleet_clusters import in_threads
from hypothesis import given
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.core.files import sha256
from calib.core.result import CovarianceTable
from calib.core.rig import Provenance, Rig
from calib.runner import engine as cluster
from calib.runner import engine as worker
from calib.runner import fleet as running
from calib.runner.engine import Cluster, connected
from calib.runner.fleet import Store, Table, column, finish, opened_store, run_fleet, texts
from calib.runner.task import (
    Answer,
    FleetOptions,
    Manifest,
    Outcome,
    RigSpec,
    is_url,
    kind_of,
    program,
    read_manifest,
    rig_folder,
    run_stages,
    without_secrets,
)
from calib.stages.camera.section import Camera, Distortion

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")
pytestmark = pytest.mark.filterwarnings("default")
"""What Dask warns of is not ours."""


@pytest.fixture(scope="module")
def here() -> Iterator[Cluster]:
    with in_threads(1, program()) as cluster:
        yield cluster


def test_failures_are_rows_and_what_is_there_is_left_alone(here: Cluster, tmp_path: Path) -> None:
    specs = []
    for k in range(5):
        images = tmp_path / f"rig{k}" / "images"
        images.mkdir(parents=True)
        (images / "a.png").write_bytes(b"no picture %d" % k)
        specs.append(RigSpec(f"rig{k}", str(images.parent), str(k)))
    specs.append(RigSpec("gone", str(tmp_path / "none")))
    manifest, said = Manifest(tuple(specs), ()), list[str]()
    with opened_store(tmp_path / "out", "calib fleet", ()) as (store, _):
        store.scratch.mkdir()
        first = run_fleet(store, here, manifest, FleetOptions(), 1, tell=said.append)
        assert first.by_status == {"failed": 6} and first.as_before == 0
        assert any(sentence.startswith("gone: failed (") for sentence in said) and len(said) == 6
        found = store.outcome("rig2")
        assert found is not None and found.serial == "2" and found.code == 3
        # Bad input is bad input again; a folder that was not there may be there now.
        (tmp_path / "rig1" / "images" / "a.png").write_bytes(b"another")
        again = run_fleet(store, here, manifest, FleetOptions(), 1)
        assert again.as_before == 4 and again.by_status == {"failed": 2} and again.done == 6
        assert not list(store.scratch.iterdir())


def slow_calibrate(spec: RigSpec, options: FleetOptions, known: str, scratch: str) -> Answer:
    """As `calibrate_rig` for a rig without anything in it; one never ends."""
    if spec.name == "endless":
        threading.Event().wait(5.0)
    return Answer(Outcome(spec.name, spec.serial, spec.source, "ok", 0), {})


def test_a_rig_that_hangs_is_a_row(here: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "calibrate_rig", slow_calibrate)
    monkeypatch.setattr(worker, "_end_process", lambda seconds: None)
    monkeypatch.setattr(worker, "_LEAVE_S", 0.01)
    manifest = Manifest(tuple(RigSpec(name, "/x") for name in ("a", "endless", "b")), ())
    with opened_store(tmp_path / "out", "calib fleet", ()) as (store, _):
        store.scratch.mkdir()
        counts = run_fleet(store, here, manifest, FleetOptions(), 1, limit_s=0.5)
        found = store.outcome("endless")
    worker._leaving.clear()
    assert counts.by_status == {"ok": 2, "lost": 1}
    assert found is not None and found.key == ""
    assert found.sentence == "was not done after 0.5 s, which is the --timeout of a rig"


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
        ("name,folder\na,b\n", "line 1: has no column path"),
        ("name,path\n../a,b\n", "line 2: the name '../a' begins with a dot"),
        ("name,path\na\\b,b\n", "in it, expected letters"),
        ("name,path\na,\n", "a has no path"),
        ("name,path\na,zip::s3://x\n", "chains several"),
        (f"name,path\n{'a' * 81},b\n", "longer than 80"),
    ],
)
def test_what_is_no_manifest_is_told_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(BadInputError) as error:
        read_manifest(_csv(tmp_path, text))
    assert said in str(error.value).replace("\\\\", "\\").replace("\\", "\\\\") or said in str(error.value)
    assert "\n" not in str(error.value)


@given(st.text(max_size=12))
def test_a_name_that_is_taken_is_a_safe_folder(name: str) -> None:
    from calib.runner.task import _problem_of_name

    if _problem_of_name(name) == "":
        path = Path("root") / name
        assert path.parent == Path("root") and path.name == name and name.isprintable()


def test_no_secret_is_kept() -> None:
    assert without_secrets("https://user:word@host:1/a/b?key=1") == "https://host:1/a/b"
    assert without_secrets("s3://bucket/a") == "s3://bucket/a"
    assert without_secrets("/data/a?b@c") == "/data/a?b@c"


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("tcp://127.0.0.1:{port}", "no scheduler answers there within 0.5 s"),
        ("nonsense://x:1", "cannot be talked to|no scheduler answers"),
    ],
)
def test_nobody_at_the_address(
    address: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    with socket.socket() as taken:
        # Bound but not listening: whoever connects is refused.
        taken.bind(("127.0.0.1", 0))
        where = address.format(port=taken.getsockname()[1])
        with pytest.raises(BadInputError, match=said), connected(where, 1, tmp_path / "w", 1):
            pass
    assert not (tmp_path / "w").exists()


def test_a_stranger_on_this_machine_cannot_enter_the_local_cluster(tmp_path: Path) -> None:
    """Not without encryption, not with a certificate of his own; and no page tells of it."""
    import psutil
    from distributed import Client
    from distributed.security import Security

    def listening() -> set[int]:
        here = psutil.Process()
        sockets = [
            one for process in (here, *here.children(recursive=True)) for one in process.net_connections()
        ]
        return {one.laddr.port for one in sockets if one.status == psutil.CONN_LISTEN}

    before = listening()
    with connected(None, 1, tmp_path / "w", 1) as ours:
        address = ours.client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        assert ours.client.submit(len, "abc").result(timeout=20) == 3
        for port in listening() - before:
            for page in ("", "status", "info/main/workers.html", "json/counts.json", "metrics", "health"):
                with pytest.raises((OSError, HTTPException)):
                    urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=2)
        strangers = ((address.replace("tls", "tcp"), None), (address, Security.temporary()))
        for where, security in strangers:
            with pytest.raises((OSError, TimeoutError)):
                Client(where, security=security, timeout=3, set_as_default=False)


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
    folder = rig_folder(root)
    assert kind_of(folder) == "camera"
    ended = run_stages(folder, "camera", (("model", "radial2"),), tmp_path / "out")
    assert ended.code == 0 and set(ended.stages.values()) == {"ok"} and ended.reasons == ()
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
    with pytest.raises(BadInputError, match="holds no images/, no logs/ and no pictures"):
        rig_folder(tmp_path / "empty")
    logs = tmp_path / "with" / "logs"
    logs.mkdir(parents=True)
    (logs / "a.csv").write_text("t_s\n")
    assert kind_of(rig_folder(tmp_path / "with")) == "run"
    flat = tmp_path / "flat"
    flat.mkdir()
    (tmp_path / "secret.png").write_bytes(b"x")
    (flat / "a.png").write_bytes(b"x")
    (flat / "b.png").symlink_to(tmp_path / "secret.png")
    assert [path.name for path in rig_folder(flat).pictures] == ["a.png"]


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
            text = rig.text().encode()
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
        summary = finish(store, manifest)
    assert summary.rigs == 31
    assert [look.name for look in summary.looks] == ["far"]
    with Table(tmp_path / "fleet.parquet") as table:
        assert table.rows == 31
        of, out = texts(table, "outlier_of"), table.read("stands_out").to_pylist()
        assert [name for name, one in zip(texts(table, "name"), out, strict=True) if one] == ["far"]
        assert of[-1] in ("camera.fx_px", "camera.fy_px") and column(table, "outlier_z")[-1] > 5.0
    assert not list((tmp_path / ".fleet").glob("*.parquet"))
