"""rig.yaml: read, written again, shown on the page, compared, put into the header and other formats."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import yaml

MODULES = (
    "calib.core.rig",
    "calib.core.files",
    "calib.core.diff",
    "calib.core.constants",
    "calib.show.page",
    "calib.stages.firmware.constants",
    "calib.stages.firmware.header",
    "calib.runner.graph",
)

WORDS = (
    b"camera:", b"plane:", b"lens:", b"imu:", b"align:", b"lowpass:", b"orientation_filter:", b"controller:",
    b"actuator:", b"pump:", b"estimator:", b"twin:", b"provenance:", b"geometry:", b"imu_intrinsics:",
    b"inputs:", b"verdict:", b"poor", b"ok", b"unidentifiable", b"reasons:", b"sigma:", b"covariance:",
    b"order:", b"values:", b"radial2", b"rational8", b"pinhole", b"k3:", b"k6:", b"- [0, 0]", b"1.0e-300",
    b"1.0e+300", b"1.0e+7", b"0.0", b"1", b"100000",
)  # fmt: skip


ODD = (
    None, 0, 1, -1, 1.5, 1e300, -1e300, 1e-300, math.nan, math.inf, 10**400, "x", "<script>alert(1)</script>",
    [], {}, [1], ["a"], {"a": 1}, {1: 2}, True, "../../x", [[1]], [None], "ok", "poor",
    {"a": {"b": [1, {"c": None}]}},
)  # fmt: skip
"""Values that stand where others belong."""


def mutate(data: bytes, dice: random.Random) -> bytes:
    """The same document with a value or two of another kind, scaled or gone; as it was if it is no YAML."""
    try:
        document = yaml.safe_load(data)
        for _ in range(dice.choice((1, 1, 2))):
            path = dice.choice(_paths(document)[1:])
            parent = document
            for key in path[:-1]:
                parent = parent[key]
            value, way = parent[path[-1]], dice.random()
            if way < 0.15:
                del parent[path[-1]]
            elif way < 0.3 and isinstance(value, float):
                parent[path[-1]] = value * dice.choice((-1.0, 1e3, 1e-3, 1e9, 0.0))
            else:
                parent[path[-1]] = dice.choice(ODD)
        return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110).encode()
    except (yaml.YAMLError, ValueError, IndexError, TypeError, AttributeError, RecursionError):
        return data


def _paths(value: Any, start: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [start, *(path for key, one in inner for path in _paths(one, (*start, key)))]


def check(data: bytes, folder: Path) -> None:
    """Whatever `Rig.load` takes, all that read a rig can work with or refuse."""
    from calib.core.errors import BadInputError
    from calib.core.rig import Rig

    path, again = folder / "rig.yaml", folder / "again.yaml"
    path.write_bytes(data)
    rig = Rig.load(path)
    text = rig.text()
    again.write_text(text, encoding="utf-8")
    if len(text) < 500_000:
        assert Rig.load(again).text() == text
    rig.outdated()
    for use in (_sections, _page, _difference, _constants, _formats):
        try:
            use(path)
        except BadInputError as error:
            refusal = str(error)
            assert refusal and "\n" not in refusal and refusal.isprintable(), repr(refusal)


def _sections(path: Path) -> None:
    from calib.core.rig import Rig

    whole = Rig.load(path)
    assert Rig().joined(whole.only(whole.sections)).values().keys() == whole.values().keys()
    assert whole.machine.plant == whole.plant


def _page(path: Path) -> None:
    from calib.show.page import page_text

    text = page_text(path)
    assert "<script>alert" not in text


def _difference(path: Path) -> None:
    from calib.core.rig import Rig

    rig = Rig.load(path)
    other = Rig.load(Path(__file__).resolve().parent / "corpus" / "rig_yaml" / "seed_camera.yaml")
    rig.diff(other)
    other.diff(rig)


def _constants(path: Path) -> None:
    from calib.core.rig import Rig
    from calib.stages.firmware.header import make_header

    whole = Rig.load(path)
    if whole.camera is not None:
        text = make_header(whole, "rig.yaml").text
        assert text.isascii() or text.isprintable


def _formats(path: Path) -> None:
    from calib.core.rig import Rig
    from calib.stages.camera.formats import from_opencv, from_ros, to_kalibr, to_opencv, to_ros

    whole = Rig.load(path)
    if whole.camera is None:
        return
    camera = whole.camera.optics
    for there, back in ((to_ros, from_ros), (to_opencv, from_opencv)):
        assert back(there(camera)).K.tolist() == camera.K.tolist()
    whole.current_plane("rig.yaml")
    assert whole.camera.intrinsic_covariance is not None or whole.camera.covariance is None
    to_kalibr(camera)
