"""The compiled filter against filterpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimatorlogs import SCENARIOS, rows_from, setup_for, simulated

from calib.arrays import FloatArray
from calib.estimator import reference, smoother
from calib.estimator.filter import starting_state
from calib.estimator.kernel import CONSIDERED, TRACE
from calib.estimator.model import Kinematic
from calib.estimator.setup import Rows, Setup
from calib.estimator.smoother import Events


def compiled(
    setup: Setup, rows: Rows, seconds: float
) -> tuple[Events, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Events of the first seconds, what was gated, states and covariances after each event, and the trace."""
    events = smoother.events_of(setup, rows, outputs=False)
    keep = events.t_s < rows.t_s[0] + seconds
    events = Events(events.t_s[keep], events.kinds[keep], events.readings[keep], events.rows[keep])
    levels, walk = setup.process.arrays()
    n, constants, begin = len(events.t_s), np.array([9.81, 0.0]), float(events.t_s[0])
    gated, trace, kept_x, kept_P = (
        np.zeros((n, 3)), np.empty((n, 3, TRACE)), np.empty((n, 19)), np.empty((n, 19, 19)),
    )  # fmt: skip
    for again in (False, True):
        x, P, w = starting_state(setup, rows)
        smoother.forward(
            events.t_s, begin, events.kinds, events.readings, *smoother.banked(x, P, w), 0.0,
            levels[None], walk, setup.view, constants, setup.noise, again, gated, np.empty((n, 1)), trace,
            kept_x, kept_P,
        )  # fmt: skip
    return events, gated, kept_x, kept_P, trace


def prepared(name: str, level: int = 2) -> tuple[Setup, Rows]:
    rig, log = simulated(name, 1)
    return setup_for(rig, 1, Kinematic((Kinematic().levels[level],))), rows_from(log)


@pytest.mark.parametrize("name", sorted(SCENARIOS))
def test_compiled_filter_equals_filterpy(name: str) -> None:
    setup, rows = prepared(name, 3 if name == "swing" else 2)
    events, gated, x, P, _ = compiled(setup, rows, 4.0)
    got_x, got_P = reference.extended(setup, rows, events, gated)
    deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    np.testing.assert_allclose(x / deviation, got_x / deviation, rtol=0, atol=1e-9)
    scale = deviation[:, :, None] * deviation[:, None, :]
    np.testing.assert_allclose(P / scale, got_P / scale, rtol=0, atol=1e-9)


def test_compiled_smoother_equals_matrices() -> None:
    setup, rows = prepared("ellipse")
    sigma, walks = setup.start.sensor_sigma.copy(), list(setup.process.sensor_walk)
    for k in CONSIDERED:
        sigma[k - 6], walks[k - 6] = 0.0, 0.0
    setup = replace(
        setup,
        start=replace(setup.start, sensor_sigma=sigma),
        process=replace(setup.process, sensor_walk=tuple(walks)),
    )
    events, _, x, P, trace = compiled(setup, rows, 2.0)
    levels, _ = setup.process.arrays()
    expected_x, expected_P = reference.extended_smoothed(setup, events, x, P)
    deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2)) + 1e-12
    smoother.backward(events.t_s, np.tile(levels[0], (len(x), 1)), trace, x, P, True)
    np.testing.assert_allclose(x / deviation, expected_x / deviation, rtol=0, atol=1e-5)
    np.testing.assert_allclose(P[:, :2, :2], expected_P[:, :2, :2], rtol=1e-4, atol=1e-14)


def test_unscented_filter_agrees_within_its_deviation() -> None:
    setup, rows = prepared("ellipse")
    events, gated, x, P, _ = compiled(setup, rows, 3.0)
    got_x, _ = reference.unscented(setup, rows, events, gated)
    late = events.t_s > rows.t_s[0] + 1.0
    deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    away = (x - got_x)[late, :2] / deviation[late, :2]
    assert np.sqrt(np.mean(away**2)) < 0.5
