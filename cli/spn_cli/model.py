"""The command `spn-model`."""

from __future__ import annotations

import click

from spn_cli.availability import availability
from spn_cli.benchmark_model import benchmark
from spn_cli.evaluate import evaluate
from spn_cli.export_model import export
from spn_cli.group import Group
from spn_cli.predict import predict
from spn_cli.train import train
from spn_cli.weights import weights


@click.group(cls=Group)
@click.version_option(package_name="squeezeposenet-toolkit")
def main() -> None:
    """Train and use networks that estimate camera poses in an area prepared by `spn-data`."""


main.add_command(train)
main.add_command(evaluate)
main.add_command(predict)
main.add_command(export)
main.add_command(availability)
main.add_command(benchmark)
main.add_command(weights)
