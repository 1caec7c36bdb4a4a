"""What `calib identify pump` says on stdout."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calib.cli.common import say, table

if TYPE_CHECKING:
    from calib.identification import PumpFound
    from calib.rig_actuator import PumpSection

__all__ = ["tell_pump"]


def _cell(value: float | None, digits: int = 3) -> str:
    return "-" if value is None or value != value else f"{value:.{digits}g}"


def tell_pump(found: PumpFound, section: PumpSection) -> None:
    """Parameters, errors on files that were not fitted, static maps, and what is not explained."""
    from calib.pumpsections import parameter_rows

    unit = found.unit
    for model, fit in found.fits.items():
        rows = [
            [name, _cell(value, 4) if sigma is not None else "off", _cell(sigma, 2), of or "-"]
            for name, value, sigma, of, _ in parameter_rows(fit, unit)
        ]
        for line in table([model, "value", "sigma", "unit"], rows):
            say(line)
    if found.fits:
        models = list(found.fits)
        held = {model: {h.name: h for h in found.held[model]} for model in models}
        rows = []
        for record in found.records:
            cells = [held[m].get(record.name) for m in models]
            free = [_cell(None if h is None else h.rms) for h in cells]
            rows.append([record.name, *free, *(_cell(None if h is None else h.ahead) for h in cells)])
        main = found.main_group
        if main is not None:
            ends = [_cell(found.held_rms(m, main.names)) for m in models]
            rows.append([f"all that settle near {main.value:.1f} {unit}", *ends, *["" for _ in models]])
        rows.append(["all", *(_cell(found.held_rms(m)) for m in models), *["" for _ in models]])
        head = [f"RMS on files not fitted, {unit}", *models, *(f"{m}, 0.5 s ahead" for m in models)]
        for line in table(head, rows):
            say(line)
        say(
            "simulated from a file's PWM and its first 0.2 s, which give the start; the extras of a model "
            "are chosen once, on all files"
        )
        kept = {model: {h.name: h for h in found.asked[model]} for model in models}
        if kept[models[0]]:
            rows = [
                [
                    name,
                    *(_cell(kept[m][name].rms) for m in models),
                    *(_cell(kept[m][name].ahead) for m in models),
                ]
                for name in kept[models[0]]
            ]
            for line in table([f"RMS on the tables kept out, {unit}", *head[1:]], rows):
                say(line)
    if found.maps:
        rows = [
            [
                m.name,
                f"{m.end:.4g} +- {_cell(m.sigma['end'], 2)}",
                f"{m.shape.dead_pwm:.1f} +- {_cell(m.sigma['dead_pwm'], 2)}",
                f"{m.shape.scale_pwm:.1f} +- {_cell(m.sigma['scale_pwm'], 2)}",
                f"{m.saturates_pwm:.0f}",
                _cell(m.scatter),
            ]
            for m in found.maps
        ]
        head = ["static map", f"at PWM 255, {unit}", "dead zone, PWM", "scale, PWM", "95 % at PWM", "scatter"]
        for line in table(head, rows):
            say(line)
    say(f"verdict: {section.verdict}")
    for sentence in (*section.reasons, *section.remarks):
        say(f"  - {sentence}")
