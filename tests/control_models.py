"""Models that several tests of controllers share."""

from __future__ import annotations

from dataclasses import replace

from source_model import PolynomialForce

from calib.stages.actuator.parameters import pumps_connected
from calib.stages.actuator.pump import Orifice, Pump
from calib.stages.control.rig_model import Model

NOMINAL = Model(pumps_connected(), Pump())
ORIFICE = Model(pumps_connected(), Pump(deflation=Orifice()))
PRINTED = Model(pumps_connected(), Pump(static=PolynomialForce()))
UNLIKE = replace(NOMINAL, strength=(0.9, 1.1))
MODELS = (NOMINAL, ORIFICE, PRINTED, UNLIKE)
