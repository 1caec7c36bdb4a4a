"""Controllers on plants that are not their model, as a script: `python tests/bench/other_plants.py`.

Each row is `calib control run REFERENCE --plant FILE`; the file states what differs from the nominal rig.
The errors are RMS of the head's place in mm, with simulated sensors, after the same start from rest.
"""

from __future__ import annotations

import sys
import tempfile
from json import loads
from pathlib import Path

from _rows import CALIB, run

REFERENCES, CONTROLLERS = ("ellipse", "elongation"), ("pd", "pd+ff", "pd+map", "tuned-pd", "torque")
PLANTS = {
    "the model's own": "{}",
    "head 25 % heavier": "{actuator: {mass_kg: 0.02075}}",
    "springs 5 % stiffer": "{actuator: {stiffness_scale: 1.05}}",
    "damping halved": "{actuator: {damping_scale_pumps_connected: 7.5}}",
    "without creep": "{actuator: {lambda2_N_per_m: 1.0e-6}}",
    "pumps 5 % weaker": "{pump: {strength: [0.95, 0.95]}}",
    "pumps 15 % weaker": "{pump: {strength: [0.85, 0.85]}}",
    "pumps unlike, +-5 %": "{pump: {strength: [1.05, 0.95]}}",
    "lag 20 % longer": "{pump: {lag_s: 0.84}}",
    "air leaves by an orifice": "{pump: {deflation: orifice}}",
}


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)

        def calib(*words: str) -> dict[str, object]:
            done = run([*CALIB, "control", *words, "--json"], folder)
            if done.code > 1:
                sys.exit(f"control {' '.join(words)}: exit code {done.code}")
            found: dict[str, object] = loads(done.output)
            return found

        calib("tune", "--rig", "rig.yaml")
        print(f"{'head, mm RMS':26s} {'reference':11s}" + "".join(f"{name:>10s}" for name in CONTROLLERS))
        for label, known in PLANTS.items():
            (folder / "plant.yaml").write_text(f"schema: 2\nknown: {known}\n", encoding="utf-8")
            for reference in REFERENCES:
                chosen = [word for name in CONTROLLERS for word in ("--controller", name)]
                told = calib("run", reference, *chosen, "--plant", "plant.yaml")
                rows = told["control"]["runs"]  # type: ignore[index]
                errors = {row["controller"]: row["head_rms_mm"] for row in rows}
                print(f"{label:26s} {reference:11s}" + "".join(f"{errors[n]:10.2f}" for n in CONTROLLERS))


if __name__ == "__main__":
    main()
