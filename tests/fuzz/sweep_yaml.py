"""Specifications of a sweep, up to the first of its cases where that is a short one."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

MODULES = ("calib.runner.sweep",)

WORDS = (
    b"base:", b"grid:", b"draws:", b"measure:", b"near:", b"controller:", b"scenario:", b"filter: fused",
    b"filter: baseline", b"reference: jump", b"feedback: truth", b"duration: 0.1s", b"duration: 1e9s",
    b"model: kinematic", b"model: driven", b"rig: rig.yaml", b"rig: ../rig.yaml", b"rig: sweep.yaml",
    b"{from: 0.8, to: 1.2, count: 5}", b"{from: 1, to: 2, count: 10000, log: true}", b"count: 1000000000",
    b"{uniform: [0, 1]}", b"{normal: [0, 1e300]}", b"{log_uniform: [1e-300, 1e300]}",
    b"actuator.mass_kg:", b"actuator.stiffness:", b"pump.lag_s:", b"twin.camera.fps:", b"scenario.Kp:",
    b"controller.orientation.Kp_pwm_per_rad:", b"estimator.tip_rms_mps2:", b"actuator.a.b.c.d:", b"[p, pid]",
    b"[1, 2]", b"[0]", b"[-1]", b"[1e308]", b"[x]", b"tuned-pid", b"swing", b"static", b"orientation",
)  # fmt: skip

_LONGEST_S = 0.5


def check(data: bytes, folder: Path) -> None:
    """Cases with parameters of their own, of which the first ends with measures or with a reason."""
    from calib.runner.sweep import cases, measured, read_sweep

    path = folder / "sweep.yaml"
    path.write_bytes(data)
    spec = read_sweep(path)
    assert 1 <= spec.cases <= 1_000_000
    first = tuple(islice(cases(spec), 3))
    assert [case.number for case in first] == list(range(len(first)))
    assert all(tuple(name for name, _ in case.values) == spec.names for case in first)
    if spec.base.duration_s is None or spec.base.duration_s > _LONGEST_S:
        return
    result = measured(first[0], spec.base, spec.draws.seed, "key", "").outcome
    assert bool(result.values) != bool(result.sentence)
    assert "internal error" not in result.sentence, result.sentence
    assert result.sentence.isprintable() and len(result.sentence) < 2000, repr(result.sentence)
