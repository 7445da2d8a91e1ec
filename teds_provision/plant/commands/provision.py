"""``provision``: what the line adds: --job, what may be built and how many, and --evidence of each board."""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision import plant
from teds_provision.cli.context import App
from teds_provision.cli.extending import add_examples, add_options, callback_of, option_of
from teds_provision.cli.options import options_given
from teds_provision.errors import UsageError
from teds_provision.links import LinkSettings
from teds_provision.station.label import require_label_packages
from teds_provision.station.station import Station

if TYPE_CHECKING:
    from teds_provision.plant.line import LineRun
    from teds_provision.provisioning.batch import ProvisionRequest


@dataclass(frozen=True)
class LineOptions:
    """The options of a line, as they were given."""

    job: str | None
    calibrations: Path | None
    files: Path | None
    only: str | None
    label_to: Path | None
    label_format: str
    scan: bool
    evidence: bool
    operator: str | None

    @property
    def names_boards(self) -> bool:
        """True if a job names what each board gets."""
        return self.job is not None

    def begin(self, app: App, base: Station, request: ProvisionRequest, links: LinkSettings) -> LineRun | None:
        """Return the line that is asked for, or None; raises UsageError if options do not go together."""
        if self.job is None and not self.evidence:
            if any(
                (
                    self.calibrations,
                    self.operator and request.report is None,
                    self.files,
                    self.only,
                    self.label_to,
                    self.scan,
                )
            ):
                raise UsageError(
                    "--calibrations, --operator, --files, --only, --label-to and --scan require a job.",
                    hint="Add --job FILE, or --evidence.",
                )
            return None
        self._check(request)
        if self.label_to is not None:
            require_label_packages(self.label_format)
        found = plant.jobs.find_job(base, self.job) if self.job is not None else None
        label = self.label_to / f"label.{self.label_format}" if self.label_to is not None else None
        line = plant.line.LineRun(
            base,
            found,
            request.order,
            self.calibrations,
            self.operator,
            only_verify=self.only is not None,
            label_to=label,
        )
        if self.scan:
            line.scans = plant.line.Scans(sys.stdin, app.note)
            threading.Thread(target=line.scans.listen, name="scanner", daemon=True).start()
        if found is not None and found.office not in (None, base.identity.fingerprint):
            office: plant.sign_requests.RemoteOffice | plant.sign_requests.JoinedOffice
            if self.files is None:
                office = plant.sign_requests.JoinedOffice(base, links.timeout)
            else:
                transport = plant.sign_requests.transport_for(base, self.files)
                office = plant.sign_requests.RemoteOffice(base, transport, links.timeout)
            line.office = office
            app.closing(office.close)
        return line

    def _check(self, request: ProvisionRequest) -> None:
        """Raise UsageError if a job is named beside an option that the job determines."""
        order = request.order
        if self.only is not None and self.job is None:
            raise UsageError("--only verify requires --job.", hint="Add --job FILE.")
        if request.sheet is not None:
            raise UsageError("--batch cannot be combined with --job or --evidence.", hint="Drop --batch.")
        if self.job is not None and not (order.names_nothing and order.accept_calibration is None and not order.retype):
            raise UsageError(
                "The job already defines what each board gets.",
                hint="Drop --profile, --calibration, --no-calibration, --name, --accept-calibration and --retype.",
            )


def extend(command: click.Command) -> None:
    """Add --job and what belongs to it, and --evidence."""
    core = callback_of(command)

    def provision(
        *,
        job: str | None,
        calibrations: Path | None,
        files: Path | None,
        only: str | None,
        label_to: Path | None,
        label_format: str,
        scan: bool,
        evidence: bool,
        **rest: Any,
    ) -> None:
        operator = rest["operator"]
        line = LineOptions(job, calibrations, files, only, label_to, label_format, scan, evidence, operator)
        if rest["adopt"] and options_given("adopt") and (rest["batch"] is not None or job is not None):
            raise UsageError("The sheet or job already defines what each board gets.", hint="Drop --adopt.")
        core(line=line, **rest)

    option_of(command, "--operator").help = "Name of the operator, for --job, --evidence or --report."
    add_options(
        command,
        "--all",
        click.Option(["--job"], metavar="FILE|ID", help="Work on a job, which defines what may be built and how many."),
        click.Option(
            ["--calibrations"],
            type=click.Path(path_type=Path),
            metavar="DIR",
            help="With --job: directory with a calibration per board: UUID.csv, .toml, .json or .xml.",
        ),
        click.Option(
            ["--files"],
            type=click.Path(path_type=Path, file_okay=False),
            metavar="DIR",
            help="With --job: transfer folder to the office, instead of the registry.",
        ),
        click.Option(
            ["--only"],
            type=click.Choice(["verify"]),
            help="With --job: test boards that other stations built; writes nothing.",
        ),
        click.Option(
            ["--label-to"],
            type=click.Path(path_type=Path, file_okay=False),
            metavar="DIR",
            help="With --job or --evidence: write a label for each board that passed.",
        ),
        click.Option(
            ["--label-format"],
            type=click.Choice(["svg", "png"]),
            default="svg",
            show_default=True,
            help="Format of the labels.",
        ),
        click.Option(
            ["--scan"],
            is_flag=True,
            help="Read scanned labels from stdin: the next board must be the one scanned.",
        ),
        click.Option(["--evidence"], is_flag=True, help="Keep signed evidence of each board; see: evidence export."),
    )
    add_examples(command, "--profile load-cell", "teds-provision provision --job fifty.jws --watch --yes")
    command.callback = provision
