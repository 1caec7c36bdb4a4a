"""`calib imu`: the verbs that are about the IMU."""

from __future__ import annotations

import typer

from calib.cli.compiling import telling
from calib.cli.imu_drift import drift
from calib.cli.imu_intrinsics import intrinsics
from calib.cli.imu_static import static
from calib.cli.imu_tune import tune

__all__ = ["imu"]

imu = typer.Typer(
    help="Understand an IMU: its bias, its noise, its drift.", no_args_is_help=True, rich_markup_mode=None
)


@imu.callback()
def _imu() -> None:
    # With a callback the name of the verb stays even while there is one alone.
    pass


imu.command("static")(static)
imu.command("intrinsics")(intrinsics)
imu.command("drift")(drift)
imu.command("tune")(telling(tune))
