"""What a campaign came to, in sentences made from its figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from logs.summary import count
from uavctl.campaign.verdict import Verdict, exceeds, group_of, percent
from uavctl.campaign.view import View


def story(view: View) -> Iterator[str]:
    """Sentences; each is true of this campaign's figures."""
    results, cells = view.results, view.cells
    refused = sum(bool(cell.refused) for cell in cells)
    failed = sum(cell.failed for cell in cells)
    flown = sum(cell.runs for cell in cells)
    yield (
        f"{count(flown, 'run')} of {count(results.steps, 'step')} were flown: {count(results.planned, 'run')} for each "
        f"of {count(len(cells) - refused, 'cell')}, all cells on the same disturbances and losses."
    )
    if refused:
        yield f"{count(refused, 'cell')} had no design and were not flown; the reasons are below."
    yield f"{count(failed, 'run')} failed; they are listed below." if failed else "No run failed."
    judged = [verdict for verdict in view.verdicts if verdict.comparisons]
    if judged:
        yield _outcome(judged)
    yield from _promise(view)


def _outcome(judged: Sequence[Verdict]) -> str:
    """How often the SMPC was below all baselines, how often one was below it, and what that one did."""
    holds, beaten = sum(v.holds for v in judged), sum(v.beaten for v in judged)
    outright = sum(v.outright for v in judged)
    text = (
        f"In {holds} of {count(len(judged), 'case')} no baseline is as cheap as the SMPC at equal or lower violation "
        f"rates; in {outright} of these each one costs more and keeps limits no better. In {beaten} a baseline costs "
        "less and breaks limits no more often."
    )
    left = len(judged) - holds - beaten
    return f"{text} In {left} the costs of such a baseline and the SMPC cannot be told apart." if left else text


def _promise(view: View) -> Iterator[str]:
    """Whether the risk promised was kept."""
    kept = [cell for cell in view.cells if cell.promised_x is not None and cell.violation_ci is not None]
    if not kept:
        return
    above = [cell for cell in kept if exceeds(cell.violation_rate or 0.0, cell.promised_x or 0.0)]
    over = [c for c in above if c.violation_ci is not None and c.violation_ci[0] > (c.promised_x or 0.0)]
    worst = max(kept, key=lambda cell: cell.violation_rate or 0.0)
    where = f"{worst.controller}, {view.place(group_of(worst))}"
    if len(above) > len(over):
        perhaps = count(len(above) - len(over), "cell")
        yield (
            f"{perhaps} of {len(kept)} broke state limits more often than the design allows, which may still be chance "
            "at so few runs."
        )
    if over:
        yield f"{count(len(over), 'cell')} of {len(kept)} broke state limits more often than the design allows."
    if not above:
        yield f"None of the {count(len(kept), 'cell')} with a promise broke state limits more often than it allows."
    stepped = [c for c in kept if c.worst_step_rate is not None and c.worst_step_ci is not None]
    if stepped:
        broke = sum(1 for c in stepped if c.worst_step_ci and c.worst_step_ci[0] > (c.promised_x or 0.0))
        highest = max(stepped, key=lambda cell: cell.worst_step_rate or 0.0)
        yield (
            f"Step by step, {count(broke, 'cell')} of {len(stepped)} left the limits more often than allowed in some "
            f"step, beyond chance; the worst step of all had {percent(highest.worst_step_rate)} "
            f"({highest.controller}, {view.place(group_of(highest))})."
        )
    yield (
        f"The most was {percent(worst.violation_rate)} of steps ({where}), where {percent(worst.promised_x)} are "
        "allowed."
    )
