"""The page of a search, and its table."""

from collections.abc import Sequence

from torchcover.evaluation import sensor_views
from torchcover.evaluation.result_page import rig_document, words_of
from torchcover.placement.result import SearchResult, is_shown
from torchcover.report import Page, PagePicture, PageRig, PageTable, Words

HEADINGS = ("found by", "objective", "measure", "gain in the\nsearch (points)", "gain on fresh\nworlds (points)", "t",
            "better in\n(worlds)", "optimism\n(points)")  # fmt: skip
OF_THE_RUN = ("seconds", "torchcover", "space_sha256")
ELSEWHERE = ("arms", "found", "sentence", "hypervolume", "share_of_instants_saved", "untested")


def search_page(result: SearchResult, pictures: Sequence[PagePicture]) -> Page:
    """All that is known of a search, on one page.

    Args:
        result: What was found.
        pictures: Of it.
    """
    search, record = result.search, result.record
    named = {"start": search.space.start, **{pick.name: pick.rig for pick in result.picks}}
    rigs = [
        PageRig(f"{name}: {rig.name}", sensor_views(rig.sensors), rig_document(rig.name, rig.sensors))
        for name, rig in named.items()
    ]
    settings = {name: value for name, value in record.items() if name not in (*OF_THE_RUN, *ELSEWHERE)}
    return Page(
        title=f"{search.space.name}: where should the sensors go?",
        lead=result.sentence,
        tables=[PageTable("Against the start", HEADINGS, _marked(result), 3), _values(result), _arms(result)],
        pictures=pictures,
        rigs=rigs,
        ego_outline_m=search.space.scenarios[0].ego_box().outline_m,
        facts={"Settings": words_of(settings), "Run": words_of({name: record[name] for name in OF_THE_RUN})},
    )


def gain_rows(result: SearchResult) -> list[tuple[str, ...]]:
    """Cells below `HEADINGS`; of what was not tested too."""
    rows = []
    for pick in result.picks:
        for objective, measure, gain in result.gains_of(pick):
            error, t = f"± {100 * gain.error:.2f}", f"{gain.t:.1f}"
            words = f"{100 * gain.search_gain:+.2f}", f"{100 * gain.gain:+.2f} {error}", t
            better, optimism = f"{gain.better} of {gain.worlds}", f"{100 * gain.optimism:+.2f}"
            row = pick.name, objective, measure, *words, better, optimism
            rows.append(tuple("-" if word == "nan" else word.replace("nan", "?") for word in row))
        if pick.test is None:
            arm = result.search.arms[pick.arm]
            gains = arm.gains[arm.evaluations.index(pick.evaluation)].tolist()
            name, measure = pick.name + " (the start)" * pick.is_start, result.search.plan.measure
            of_search = zip(result.search.space.objectives, gains, strict=True)
            rows += [(name, objective, measure, f"{100 * gain:+.2f}", *"----") for objective, gain in of_search]
    return rows


def _marked(result: SearchResult) -> list[tuple[Words, ...]]:
    significant = {
        (pick.name, objective, measure)
        for pick in result.picks
        for objective, measure, gain in result.gains_of(pick)
        if is_shown(gain)
    }
    return [
        tuple(Words(word, "significant" if at == 4 and row[:3] in significant else "") for at, word in enumerate(row))
        for row in gain_rows(result)
    ]


def _values(result: SearchResult) -> PageTable:
    variables = [variable.name for variable in result.search.space.variables]
    start = result.search.space.start_values()
    columns = {"start": start} | {pick.name: pick.evaluation.values for pick in result.picks}
    rows = [(Words(name), *(Words(_value(values.get(name))) for values in columns.values())) for name in variables]
    return PageTable("Values", ("variable", *columns), rows)


def _value(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _arms(result: SearchResult) -> PageTable:
    arms = result.record["arms"]
    headings = ("arm", *next(iter(arms.values())))
    rows = [(Words(name), *(Words(f"{value:g}") for value in arm.values())) for name, arm in arms.items()]
    notes = [f"Racing saved {result.search.share_saved:.0%} of the instants."]
    if volumes := result.record["hypervolume"]:
        notes.append("Hypervolume: " + ", ".join(f"{name} {volume:.3g}" for name, volume in volumes.items()) + ".")
    return PageTable("What was spent", headings, rows, notes=notes)
