"""What the page says of stages: facts with units, tables of any document, words for figures."""

from __future__ import annotations

from calib.report.page_stages import caption, facts, tables
from calib.rigvalues import BLANK, SIGMA


def test_facts_have_units_and_error_bars() -> None:
    camera = {
        "fx_px": 273.40956,
        "sigma": {"fx_px": 0.0435},
        "rms_px": 0.0098,
        "views": 17,
        "model": "radial2",
    }
    told = dict(facts("intrinsics", camera, {}))
    assert told["focal length"] == "273.410 ± 0.043 px" and told["RMS"] == "0.0098 px"
    assert told[f"projection {SIGMA}, worst"] == "not bounded" and "points" not in told
    align = {"time_offset_s": 0.02493, "sigma": {"time_offset_s": 0.00013}}
    assert dict(facts("align", align, {}))["time offset"] == "24.93 ± 0.13 ms"
    assert facts("of later", {"a": 1}, {}) == []


def test_any_list_of_records_is_a_table() -> None:
    document = {
        "schema": 1,
        "verb": "validate",
        "validate": {
            "claims": [
                {"claim": "2.4", "error_mm": 0.25, "outcome": "reproduced", "trace": [1, 2, 3, 4]},
                {"claim": "<b>", "error_mm": None, "outcome": "refuted", "ok": True},
            ],
            "models": {"linear": {"rms_kPa": 1.0}, "orifice": {"rms_kPa": 0.5}},
        },
        "per_view": [{"view": "a"}],
    }
    claims, models = tables(document)
    assert claims.title == "validate claims" and claims.heads == ("claim", "error, mm", "outcome", "ok")
    assert [cell.text for cell in claims.rows[0]] == ["2.4", "0.25", "reproduced", BLANK]
    assert claims.rows[0][1].number == 0.25 and claims.rows[1][3].text == "yes"
    assert models.heads == ("name", "rms, kPa") and models.rows[1][0].text == "orifice"
    assert all(len(row) == len(table.heads) for table in (claims, models) for row in table.rows)


def test_models_beside_each_other_for_each_log() -> None:
    models = {"original": {"q1": {"rms_m": 0.1}}, "improved": {"q1": {"rms_m": 0.05}}}
    (table,) = tables({"validate": {"logs": [{"log": "a.csv", "models": models}]}})
    assert table.heads == ("log", "model", "q1 rms, m")
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["a.csv", "original", "0.1"], ["a.csv", "improved", "0.05"],
    ]  # fmt: skip


def test_nothing_odd_in_a_document_breaks_it() -> None:
    for odd in (
        {},
        {"a": None},
        {"a": [1, {"b": 2}]},
        {"a": [[]]},
        {"a": [{"models": 3}]},
        {"a": [{"models": {"b": 1}}]},
        {"a": {"b": {"c": {"d": {"e": [{}]}}}}},
    ):
        assert isinstance(tables(odd), list)


def test_captions() -> None:
    assert caption("camera_sigma").startswith("Standard deviation")
    assert caption("replay_swing_1_states") == f"States with their 2{SIGMA} bands: swing 1"
    assert caption("align_residuals_2", ["a.csv", "b.csv"]) == "Residuals: b.csv"
    assert caption("something_new") == "something new"
