"""Draw the calibration chessboard as a PDF page at true scale, for printing."""

from __future__ import annotations

from typing import NamedTuple

_POINTS_PER_MM = 72.0 / 25.4
_A4_MM = (297.0, 210.0)  # landscape


class Chessboard(NamedTuple):
    """Size of a chessboard: number of inner corners and side of a square."""

    corners: tuple[int, int]  # along the long side, along the short side
    square_m: float  # side of a square


# Also the board of `calibrate extrinsics --target board`; fits A4 with the margins of usual printers.
DEFAULT_CHESSBOARD = Chessboard((11, 8), 0.020)


def chessboard_pdf(board: Chessboard = DEFAULT_CHESSBOARD) -> bytes:
    """Return a PDF file of one A4 page (landscape) with the board and a text with its dimensions.

    Raises:
        ValueError: the board does not fit on A4.
    """
    columns, rows = board.corners[0] + 1, board.corners[1] + 1
    side_mm = board.square_m * 1e3
    left, bottom = (_A4_MM[0] - columns * side_mm) / 2.0, (_A4_MM[1] - rows * side_mm) / 2.0 + 2.0
    if left < 5.0 or bottom < 5.0:
        raise ValueError(f"{columns} x {rows} squares of {side_mm:g} mm do not fit on A4")
    drawing = [f"{_POINTS_PER_MM:.6f} 0 0 {_POINTS_PER_MM:.6f} 0 0 cm 0 g"]  # millimetres from here on
    for column in range(columns):
        for row in range(rows):
            if (column + row) % 2 == 0:
                drawing.append(
                    f"{left + column * side_mm:.4f} {bottom + row * side_mm:.4f} {side_mm:g} {side_mm:g} re f"
                )
    words = f"Print at 100 %. Squares of {side_mm:g} mm: measure ten of them. Glue it on a flat plate."
    drawing.append(f"BT /F1 3.5 Tf {left:.2f} {bottom - 7.0:.2f} Td ({words}) Tj ET")
    content = "\n".join(drawing).encode()
    size = " ".join(f"{mm * _POINTS_PER_MM:.3f}" for mm in _A4_MM)
    return _pdf([
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size}] /Contents 4 0 R "
        "/Resources << /Font << /F1 << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
    ])  # fmt: skip


def _pdf(objects: list[bytes]) -> bytes:
    """Return a PDF file made of these objects; the first one is the catalogue (ISO 32000-1, 7.5)."""
    out, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, start=1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    end = b"xref\n0 %d\n0000000000 65535 f \n%s" % (len(objects) + 1, table)
    return out + end + b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (
        len(objects) + 1, len(out),
    )  # fmt: skip
