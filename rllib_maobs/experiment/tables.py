"""Tables and times as text."""


def format_time(seconds: float | None) -> str:
    """Write a duration as hours, minutes and seconds; "-" if it is not known."""
    if seconds is None:
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def format_table(header: list[str], rows: list[list[str]], *, markdown: bool = False) -> str:
    """Align cells: the first column to the left, the numbers to the right.

    Args:
        header: Names of the columns.
        rows: Their cells.
        markdown: Whether to draw the lines of a markdown table.

    Returns:
        The table, without a newline at the end.
    """
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]

    def line(cells: list[str]) -> str:
        padded = [cells[0].ljust(widths[0])]
        padded += [cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True)]
        return f"| {' | '.join(padded)} |" if markdown else "  ".join(padded).rstrip()

    lines = [line(header), *map(line, rows)]
    if markdown:
        lines.insert(1, line(["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]))
    return "\n".join(lines)
