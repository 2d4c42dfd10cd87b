"""Options that the area remembers: what was stated about its flights when it was mapped or georegistered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from spn_cli import console, options
from spn_data.area.area import Area
from spn_data.errors import InputError

_OF_FLIGHTS = "--fov"  # added flights may have another one


def fill(area: Area, chosen: dict[str, Any]) -> dict[str, Any]:
    """Return the options of the present command, with those that were not given as they were given before.

    Prints one line that names what was taken, and how to change it. Raises InputError if area.toml has an
    option that is not remembered, or a value that is none.
    """
    context = click.get_current_context()
    known = _remembered(context)
    for name in area.facts.options:
        if f"--{name}" not in options.REMEMBERED:
            listed = ", ".join(option.removeprefix("--") for option in options.REMEMBERED)
            raise InputError(
                f"options has {name!r:.60}, which is not remembered; it may have {listed}",
                path=area.facts_path,
            )
    filled, taken = dict(chosen), []
    for option, parameter in known.items():
        words = area.facts.options.get(option.removeprefix("--"))
        if words is None or _is_given(context, parameter):
            continue
        filled[parameter.name or ""] = _value(area, context, parameter, words)
        taken.append(f"{option} {' '.join(words)}" if not _is_flag(parameter) else option)
    if taken:
        console.note(
            f"taken as given before (options in {area.facts_path}): {', '.join(taken)}. Give an option again "
            "to change it, or remove it there."
        )
    return filled


def keep(area: Area, chosen: dict[str, Any], *, add: bool = False) -> None:
    """Write the options that were given into area.toml, after the command has succeeded with them.

    add : whether flights were added: a field of view is then that of the added ones only.
    """
    context = click.get_current_context()
    kept = dict(area.facts.options)
    for option, parameter in _remembered(context).items():
        if not _is_given(context, parameter):
            continue
        name = option.removeprefix("--")
        words, before = _words(area, parameter, chosen[parameter.name or ""]), kept.get(name)
        is_of_added = add and option == _OF_FLIGHTS
        if before not in (None, words):
            now, then = " ".join(words), " ".join(before or ())
            what = (
                f"is of the added flights; the others keep {then}"
                if is_of_added
                else f"replaces {then}"
            )
            console.note(f"{option} {now} {what} (options in {area.facts_path}).")
        if not is_of_added:
            kept[name] = words
    area.write_facts(replace(area.facts, options=kept))


def _remembered(context: click.Context) -> dict[str, click.Parameter]:
    """Return the parameters of the present command that the area remembers, by option."""
    return {
        option: parameter
        for parameter in context.command.params
        for option in parameter.opts
        if option in options.REMEMBERED
    }


def _is_given(context: click.Context, parameter: click.Parameter) -> bool:
    source = context.get_parameter_source(parameter.name or "")
    return source is not ParameterSource.DEFAULT


def _is_flag(parameter: click.Parameter) -> bool:
    return isinstance(parameter, click.Option) and parameter.is_flag


def _is_path(parameter: click.Parameter) -> bool:
    return isinstance(parameter.type, click.Path)


def _value(
    area: Area, context: click.Context, parameter: click.Parameter, words: tuple[str, ...]
) -> Any:
    """Return the value of the words of an option, checked as if they were typed."""
    if _is_flag(parameter):
        return True
    several = parameter.multiple or parameter.nargs != 1
    if not several and len(words) != 1:
        raise InputError(f"options: {parameter.opts[0]} is not one text", path=area.facts_path)
    if _is_path(parameter):
        words = tuple(str(area.root / word) for word in words)
    try:
        return parameter.process_value(context, words if several else words[0])
    except click.UsageError as error:
        raise InputError(
            f"options: {parameter.opts[0]}: {error.message}", path=area.facts_path
        ) from error


def _words(area: Area, parameter: click.Parameter, value: Any) -> tuple[str, ...]:
    """Return the words that give a value again."""
    if _is_flag(parameter):
        return ("true",)
    if _is_path(parameter):
        return (area.stored_path(Path(value)),)
    if parameter.multiple:
        return tuple(str(v) if name == "*" else f"{name}={v}" for name, v in value)
    if parameter.nargs != 1:
        return tuple(str(v) for v in value)
    return (",".join(str(v) for v in value) if isinstance(value, tuple) else str(value),)
