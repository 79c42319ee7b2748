"""Write tables of benchmark results into a Markdown file, between two marks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from beamsplat.common.errors import UserError

_PAPER_COLUMNS = ("configuration", "position RMSE, m", "images/s", "CPU s per image", "depth RMSE, m",
                  "map off the path, dB", "p95 to the map, s", "memory, MB")  # fmt: skip


def replace_readme_table(readme: Path, bench: str, table: str) -> None:
    """Replace the text between <!-- bench NAME --> and <!-- /bench NAME --> in a file with a table.

    Args:
        readme: the Markdown file.
        bench: NAME of the marks.
        table: the table in Markdown.

    Raises:
        UserError: the marks are missing.
    """
    begin, end = f"<!-- bench {bench} -->", f"<!-- /bench {bench} -->"
    text = readme.read_text()
    if begin not in text or end not in text:
        raise UserError(
            f"{readme}: the lines {begin} and {end}, between which the table is written, are missing"
        )
    head, tail = text.split(begin)[0], text.split(end)[1]
    readme.write_text(f"{head}{begin}\n{table}\n{end}{tail}")


def paper_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of `bench paper` in Markdown, with the results published in the paper in brackets.

    `rows` are the entries of `configurations` in the report.
    """
    lines = ["| " + " | ".join(_PAPER_COLUMNS) + " |", "|---" * len(_PAPER_COLUMNS) + "|"]
    for row in rows:
        paper = row["paper"]
        cpu_s = paper["cpu_load_percent"] / 100.0 / paper["fps"] if paper else None
        latency_ms, memory = row.get("keyframe_latency_p95_ms"), row.get("peak_rss_mb")
        map_db = _number(row.get("psnr_offpath_db"), 1)
        if row.get("refined_psnr_offpath_db") is not None:
            map_db += f", refined {row['refined_psnr_offpath_db']:.1f}"
        name = row["title"] + (f" [{row['depth_source']}]" if row["advice"] else "")
        cells = [
            name,
            _with_reference(row.get("position_rmse_m"), 4, paper.get("position_rmse_m")),
            _with_reference(row.get("fps"), 1, paper.get("fps")),
            _with_reference(row.get("cpu_s_per_image"), 2, cpu_s),
            _with_reference(row.get("depth_rmse_scaled_m"), 2, paper.get("depth_rmse_scaled_m")),
            map_db,
            _number(None if latency_ms is None else latency_ms * 1e-3, 1),
            _number(memory, 0),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _with_reference(value: float | None, digits: int, theirs: float | None) -> str:
    return _number(value, digits) + ("" if theirs is None else f" ({theirs:.{digits}f})")
