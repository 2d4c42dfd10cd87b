"""The command `spn-model weights`."""

from __future__ import annotations

import click

from spn_cli import console, output


@click.group(invoke_without_command=True)
@click.pass_context
def weights(context: click.Context) -> None:
    """List published network weights and whether they are on this machine.

    \b
    Example:
        spn-model weights
        spn-model weights fetch googlenet
    """
    if context.invoked_subcommand is not None:
        return
    from dataclasses import asdict

    from spn_model.pretrained.weights import CATALOGUE, cache_folder, state

    rows = []
    output.figures(
        weights=[{**asdict(entry), "state": state(entry)} for entry in CATALOGUE],
        folder=cache_folder(),
    )
    for entry in CATALOGUE:
        size = f"{entry.size_bytes / 1e6:.1f} MB"
        rows.append((entry.name, entry.holds, state(entry), entry.origin, size, entry.sha256[:8]))
    console.table("Weights", rows, ("name", "holds", "here", "from", "size", "SHA-256"))
    console.say(f"Downloaded files are stored in {cache_folder()}.")
    if any("damaged" in row for row in rows):
        console.note("damaged files are not used; spn-model weights fetch NAME replaces them.")


@weights.command()
@click.argument("name")
def fetch(name: str) -> None:
    """Download weights by name and verify their SHA-256 hash.

    \b
    Example:
        spn-model weights fetch googlenet
    """
    from spn_model.pretrained.weights import by_name
    from spn_model.pretrained.weights import fetch as download

    entry = by_name(name)
    with console.progress() as progress:
        path = download(entry, progress)
    output.figures(written=path)
    console.say(f"{path}: {entry.holds}; {entry.licence}.")
