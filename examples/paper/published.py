"""What is known of the paper's tables, beside the numbers that were measured."""

from torchcover.report import CoverageTable, as_markdown, parts_of

# Experiment, region and height -> mean blind spot radius.
PUBLISHED_RADIUS = {("mounting", "20m", "ground"): "grille 1.41, roof 1.93"}
NOT_KNOWN = "–"


def with_published(experiment: str, table: CoverageTable) -> str:
    """The table of an experiment as Markdown, with a column for what the paper states beside the radii."""
    places = [(experiment, row.summary.region, row.summary.height) for row, *_ in table.places]
    published = [PUBLISHED_RADIUS.get(place, NOT_KNOWN) for place in places]
    return as_markdown(
        table,
        [part.with_column("paper (m)", published) if _has_radii(part) else part for part in parts_of(table)],
    )


def _has_radii(part):
    return not part.of_differences and any(quantity.key == "radius_m" for quantity in part.quantities)
