"""The verb of a stage: its options from their declaration, its words and JSON from its result."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer
from typer.core import TyperGroup

from calib.cli import common
from calib.core.errors import EXIT_POOR
from calib.core.files import shown
from calib.core.options import LogOptions, flag_of, options_of
from calib.core.stage import AnyStage, Files
from calib.core.words import as_text
from calib.stages import STAGES, stage


def verb(stage: AnyStage) -> Callable[..., None]:
    """The function that typer makes a command of."""
    flags = [one.name for one in fields(stage.options)]

    def command(**values: Any) -> None:
        sources = values.get("sources")
        paths = () if sources is None else (sources,) if isinstance(sources, Path) else tuple(sources)
        options = options_of(
            stage.options, {name: values[name] for name in flags if values[name] is not None}
        )
        figures = values.get("figures")
        files = Files(
            paths,
            values["rig"],
            values.get("output"),
            common.narrate,
            common.progress_bar,
            figures=figures is not None,
            keep=False,
        )
        _run(stage, files, options, figures, values["as_json"])

    command.__name__ = stage.name.split()[-1]
    command.__doc__ = stage.summary
    _declare(command, _parameters(stage))
    return command


def _parameters(stage: AnyStage) -> list[inspect.Parameter]:
    kind = inspect.Parameter.KEYWORD_ONLY
    out: list[inspect.Parameter] = []
    if stage.sources:
        shape: Any = list[Path] if stage.several else Path
        default: Any = inspect.Parameter.empty
        if stage.optional:
            shape, default = shape | None, None
        argument = typer.Argument(help=stage.sources, metavar=stage.metavar or None, show_default=False)
        out.append(inspect.Parameter("sources", kind, default=default, annotation=Annotated[shape, argument]))
    out += _switches(stage.options)
    if stage.output is not None:
        made = stage.output
        switch = typer.Option(*made.flags, help=made.words, metavar=made.metavar or None)
        shape = Path if made.default is not None else Path | None
        out.append(
            inspect.Parameter("output", kind, default=made.default, annotation=Annotated[shape, switch])
        )
    if stage.plots is not None:
        out.append(inspect.Parameter("figures", kind, default=None, annotation=common.FiguresOption))
    out.append(inspect.Parameter("rig", kind, default=Path("rig.yaml"), annotation=common.RigOption))
    out.append(inspect.Parameter("as_json", kind, default=False, annotation=common.JsonOption))
    return out


def _switches(options: type[Any]) -> Iterator[inspect.Parameter]:
    """The options of a class on the command line."""
    hints = get_type_hints(options)
    for one in fields(options):
        meta, default = one.metadata, None if one.default is MISSING else one.default
        # What has a parser is typed with its unit, and has its default in the help's words.
        shape: Any = str | None if meta["parse"] is not None else _several(hints[one.name])
        name = f"--{flag_of(one)}"
        if hints[one.name] == bool | None:
            # Left open it is neither.
            name += f"/--no-{name.removeprefix('--')}"
        switch = typer.Option(name, help=meta["words"], metavar=meta["metavar"] or None, min=meta["least"])
        default = None if meta["parse"] is not None else default
        kind = inspect.Parameter.KEYWORD_ONLY
        yield inspect.Parameter(one.name, kind, default=default, annotation=Annotated[shape, switch])


def of_logs(function: Callable[..., None]) -> Callable[..., None]:
    """A verb that takes what a person states of logs as options of its own, and gets it as `stated`."""

    @functools.wraps(function)
    def command(*paths: Any, **values: Any) -> None:
        stated = {one.name: values.pop(one.name, None) for one in fields(LogOptions)}
        function(*paths, stated=LogOptions(**stated), **values)

    hints, parameters = get_type_hints(function, include_extras=True), list[inspect.Parameter]()
    for one in inspect.signature(function).parameters.values():
        if one.name == "stated":
            parameters += _switches(LogOptions)
        else:
            own = one.replace(annotation=hints[one.name], kind=inspect.Parameter.KEYWORD_ONLY)
            parameters.append(own)
    _declare(command, parameters)
    return command


def _declare(command: Callable[..., None], parameters: Sequence[inspect.Parameter]) -> None:
    """What typer and help() read."""
    command.__annotations__ = {one.name: one.annotation for one in parameters}
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # no function has it before


def _several(hint: Any) -> Any:
    """A type as typer takes it: what may be repeated is a list there."""
    for one in (str, Path):
        many: Any = tuple[one, ...]  # type: ignore[valid-type]  # it is a value here
        if hint in (many, many | None):
            return list[one] if hint == many else list[one] | None  # type: ignore[valid-type]  # as above
    return hint


def _run(stage: AnyStage, files: Files, options: Any, figures: Path | None, as_json: bool) -> None:
    from calib.runner.work import carry_out

    outcome, after = carry_out(stage, files, options, files.rig_path, figures)
    sections = stage.sections(outcome)
    if figures is not None:
        common.narrate(f"figures in {shown(figures)}")
    if as_json:
        common.emit_json(stage.as_json(outcome, files.written))
    else:
        for line in as_text(stage.blocks(outcome)):
            common.say(line)
    for name in sections:
        common.narrate(f"{after.name_in_file(name)} written to {shown(files.rig_path)}")
    for sentence in () if stage.remarks is None else stage.remarks(after):
        common.narrate(sentence)
    files.finish()
    if not stage.verdict(outcome).ok:
        raise typer.Exit(EXIT_POOR)


class OneByDefault(TyperGroup):
    """`calib identify LOG...` is `calib identify logs LOG...`, or `identify arm` of logs with pressures."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """The arguments with the verb that they leave out."""
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = ["arm" if _of_arm(args) else "logs", *args]
        return super().parse_args(ctx, args)


def _of_arm(args: list[str]) -> bool:
    """Whether the first argument that is a file is a log of a pressure-driven arm."""
    from calib.io.columns import is_arm_log
    from calib.io.logs import read_column_names

    first = next((path for path in map(Path, args) if path.is_file()), None)
    return first is not None and is_arm_log(read_column_names(first) or ())


def group(name: str, words: str, cls: type[TyperGroup] = TyperGroup) -> typer.Typer:
    """The verbs of two words that begin with this one."""
    made = typer.Typer(name=name, cls=cls, help=words, no_args_is_help=True, rich_markup_mode=None)
    for one in STAGES:
        if one.startswith(f"{name} "):
            made.command(one.split()[-1])(common.telling(verb(stage(one))))
    return made
