"""The compiled loop's rig is the twin's: the same states, pixels and samples."""

from __future__ import annotations

import math

import numpy as np
from firmware_plant import Loop

from calib.stages.actuator.simulate import rig_at_rest
from calib.twin.rig import SimulatedRig
from calib.twin.simulate import simulate


def test_states_and_readings_are_those_of_the_twin() -> None:
    rig, ticks = SimulatedRig(), 400
    k = np.arange(ticks)
    pwm = np.stack([150.0 + 80.0 * np.sin(0.05 * k), 150.0 + 80.0 * np.cos(0.03 * k)], axis=1)
    wanted = simulate(rig, rig_at_rest(rig.plant, rig.pump), pwm, ticks, seed=5)
    loop = Loop(rig, ticks, seed=5)
    newest = np.searchsorted(wanted.imu.taken_s, wanted.t_s + 1e-9, side="right") - 1
    seen = 0
    for i in range(ticks):
        there = loop.look(i)
        u, v, ax, ay, gz = loop.record[:5].tolist()
        assert there == (not math.isnan(wanted.pixels[i, 0]))
        if there:
            assert (u, v) == tuple(wanted.pixels[i])
            seen += 1
        assert np.abs(np.array([ax, ay]) - wanted.accel_mps2[newest[i], :2]).max() < 1e-9
        assert abs(gz - wanted.gyro_radps[newest[i], 2]) < 1e-9
        loop.move(i, pwm[i])
    assert seen > 380
    assert np.abs(loop.nodes - wanted.trajectory.nodes).max() < 1e-12
