"""The tables of an experiment as Markdown, with a column for what the paper states."""

# What is known of the paper's tables: experiment, region and height -> mean blind spot radius.
PUBLISHED_RADIUS = {("mounting", "20m", "ground"): "grille 1.41, roof 1.93"}
NOT_KNOWN = "–"


def as_markdown(experiment, tables):
    """One text for all the tables that an experiment prints, captions included."""
    return "\n".join(part for table in tables for part in _table(experiment, table))


def _table(experiment, table):
    headings = [" ".join(str(column.header).split()) for column in table.columns]
    rows = [[_cell(cell) for cell in row] for row in zip(*(column.cells for column in table.columns), strict=True)]
    title = str(table.title or "")
    if "radius" in f"{title} {headings}" and "ifference" not in title:
        headings.append("paper (m)")
        for row in rows:
            row.append(PUBLISHED_RADIUS.get((experiment, row[0], row[1]), NOT_KNOWN))
    if title:
        yield f"{title}\n"
    yield _line(headings)
    yield _line(["---", "---", *["---:"] * (len(headings) - 2)])
    yield from map(_line, rows)
    yield ""
    if table.caption:
        yield from (f"* {note.lstrip('*! ')}" for note in str(table.caption).splitlines())
        yield ""


def _cell(cell):
    # The best of a row is bold here; its mark is for terminals.
    return f"**{str(cell).lstrip('*! ')}**" if getattr(cell, "style", "") == "bold" else str(cell)


def _line(cells):
    return f"| {' | '.join(cells)} |"
