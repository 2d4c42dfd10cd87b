"""The command `spn-model`."""

from __future__ import annotations

import click

from cli.console import Group


@click.group(cls=Group)
@click.version_option(package_name="squeezeposenet-toolkit")
def main() -> None:
    """Train and evaluate pose regressors.

    This version prepares areas (`spn-data`); it has no commands for networks yet.
    """
