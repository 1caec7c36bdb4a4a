"""Manifests of a fleet, as CSV and as YAML, up to the places of the results."""

from __future__ import annotations

from pathlib import Path

MODULES = ("calib.runner.fleet",)

WORDS = (
    b"name,path,serial", b"name", b"path", b"serial", b"corners", b"square", b"model", b"loss", b"board",
    b"rigs:", b"options:", b"- {name: a, path: b}", b"../a", b"/etc", b"s3://bucket/a", b"file:///etc",
    b"memory://a::b", b"http://user:secret@host/a", b"radial2", b"huber", b"warp", b"7x5", b"25mm",
    b"\"a\nb\"",
    b"AX-0017", b"CON", b"a.", b".a", b"a/b", b"A", b"\xc3\x84", b",", b"\"",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """Rigs with names that are folders of their own in an output folder, or a refusal."""
    from calib.core.errors import BadInputError
    from calib.runner.fleet import OPTIONS, is_url, read_manifest, serial_number
    from calib.runner.outcomes import Store

    store, refusals = Store(folder / "out", folder / "out" / ".fleet"), list[BadInputError]()
    for ending in ("csv", "yaml"):
        path = folder / f"manifest.{ending}"
        path.write_bytes(data)
        try:
            manifest = read_manifest(path)
        except BadInputError as refusal:
            assert str(refusal).isprintable() and len(str(refusal)) < 2000, repr(str(refusal))
            refusals.append(refusal)
            continue
        assert len({rig.name.casefold() for rig in manifest.rigs}) == len(manifest.rigs) > 0
        for rig in manifest.rigs:
            place = (store.out / "rigs" / rig.name / "rig.yaml").resolve()
            assert place.parent.parent == (folder / "out" / "rigs").resolve(), rig.name
            assert is_url(rig.source) or Path(rig.source).is_absolute()
            assert (rig.name + rig.source + rig.serial).isprintable()
            assert {key for key, _ in rig.options} <= set(OPTIONS)
            number = serial_number(rig.serial)
            assert number is None or 0 <= number < 1e15
    if len(refusals) == 2:
        raise refusals[data.lstrip().startswith((b"rigs", b"options"))]
