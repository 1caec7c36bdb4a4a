"""After all rigs: the table of the fleet, its summary, and what rigs borrow from a prior."""

from __future__ import annotations

import contextlib

import numpy as np

from calib.runner.fleet import (
    HIDDEN,
    Borrowing,
    FleetSummary,
    Prior,
    Store,
    borrow,
    summarise,
    with_columns,
    write_outcomes,
)
from calib.runner.task import Manifest, needed


def finish(
    store: Store, manifest: Manifest, prior: Prior | None = None
) -> tuple[FleetSummary, Borrowing | None]:
    """Write fleet.parquet and return the summary, and what was borrowed where a prior was given.

    Raises `BadInputError` when a file cannot be written.
    """
    pa = needed("pyarrow")
    between, final = store.out / HIDDEN / "rows.parquet", store.out / "fleet.parquet"
    write_outcomes(between, [rig.name for rig in manifest.rigs], store.outcome)
    try:
        summary, worst, which = summarise(between)
        known = np.isfinite(worst)
        added = {
            "outlier_z": pa.array(worst, mask=~known),
            "outlier_of": pa.array(which, type=pa.string()),
            "stands_out": pa.array(known & (worst > summary.limit)),
        }
        with_columns(between, final, added)
    finally:
        with contextlib.suppress(OSError):
            between.unlink()
    told = None if prior is None else borrow(store, manifest, prior)
    return summary, told
