"""Command `uavctl campaign`: its options; without the extra `campaign` its help can be read all the same."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from uavctl.cli.common import WORKERS, QuietJson
from uavctl.errors import need
from uavctl.lab.campaign.spec import MAX_RUNS


def campaign(
    spec: Annotated[Path, Parameter(help="TOML file of the campaign", show_default=False)],
    *,
    runs: Annotated[
        int | None,
        Parameter(help="runs of each cell; else the file's", validator=validators.Number(gte=1, lte=MAX_RUNS)),
    ] = None,
    workers: Annotated[
        int | None, Parameter(help="processes that fly; else one for each processor", validator=WORKERS)
    ] = None,
    dask: Annotated[str | None, Parameter(help="fly on the workers of the Dask scheduler at this address")] = None,
    out: Annotated[Path | None, Parameter(help="folder of the results; else a new one below flights/")] = None,
    resume: Annotated[
        bool, Parameter(negative=(), show_default=False, help="continue the interrupted campaign in --out")
    ] = False,
    json: QuietJson = False,
) -> int:
    """Fly a grid of controllers, links, disturbances and plants, each on the same noise and the same losses.

    With `world = "quadrotor"` in its file it is flights of the true vehicle, beside its own position loop.

    The results do not depend on the number of workers, nor on where they are. Every finished task is kept at once: a
    campaign that was interrupted or killed goes on with --resume.
    """
    need("pyarrow", "campaign")
    if dask is not None:
        need("distributed", "cluster")
    from uavctl.cli.campaign_run import fly_campaign

    return fly_campaign(spec, runs=runs, workers=workers, dask=dask, out=out, resume=resume, json=json)
