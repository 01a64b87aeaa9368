"""`share calibrate target`: write a calibration board to print."""

from __future__ import annotations

from pathlib import Path

import click

from share.errors import UsageError


@click.command(short_help="Write a calibration board to print, and its YAML file.")
@click.option(
    "--kind", type=click.Choice(["aprilgrid", "charuco"]), default="aprilgrid", show_default=True,
    help="Pattern of the board.",
)  # fmt: skip
@click.option(
    "--paper", metavar="P", default="A4", show_default=True,
    help="Paper: A4 to A0, letter, tabloid, or WIDTHxHEIGHT in mm.",
)  # fmt: skip
@click.option(
    "--columns",
    type=click.IntRange(1),
    metavar="N",
    help="Columns of the board.  [default: 6 tags or 9 squares]",
)
@click.option(
    "--rows", type=click.IntRange(1), metavar="N", help="Rows of the board.  [default: 6 tags or 7 squares]"
)
@click.option(
    "--size", type=click.FloatRange(0, min_open=True), metavar="MM",
    help="Edge of a tag or square, mm.  [default: the largest whole mm that fit]",
)  # fmt: skip
@click.option(
    "--out", required=True, metavar="B.pdf", type=click.Path(path_type=Path, dir_okay=False),
    help="Sheet to write; B.yaml goes beside it.",
)  # fmt: skip
def target(
    kind: str, paper: str, columns: int | None, rows: int | None, size: float | None, out: Path
) -> None:
    """Write a calibration board as a PDF, true to scale, and a YAML file that describes it (for --target).

    Print at 100 % ("actual size"), glue the sheet to something flat and stiff, and measure the edge of a tag
    or square: if it differs from the sheet's figure, correct the YAML file. If B.yaml exists and describes
    another board, it is kept and nothing is written.

    \b
    Example:  share calibrate target --paper A3 --out board.pdf
              share calibrate camera board.mcap --target board.yaml --out calib/mine
    """
    import yaml

    from share.files.writing import atomic_write, check_replaceable, check_writable
    from share.lab.calibrate.camera_report import has_target
    from share.lab.calibrate.target import target_mapping
    from share.lab.calibrate.target_sheet import DEFAULT_SIZES, describe_sheet, make_sheet, sheet_pdf

    if out.suffix.lower() != ".pdf":
        raise UsageError(f"--out {out}: give a name that ends in .pdf")
    default_size = DEFAULT_SIZES[kind]
    try:
        target_sheet = make_sheet(kind, columns or default_size[0], rows or default_size[1], paper, size)
    except ValueError as error:
        raise UsageError(str(error)) from None
    yaml_file = out.with_suffix(".yaml")
    check_writable(out)
    check_replaceable(yaml_file)
    yaml_exists = yaml_file.exists()
    if yaml_exists and not has_target(yaml_file, target_sheet.target):
        raise UsageError(
            f"{yaml_file} describes another board, or its size was corrected, and is kept; give another "
            "--out, or move it away"
        )
    atomic_write(out, sheet_pdf(target_sheet))
    if not yaml_exists:
        atomic_write(yaml_file, yaml.safe_dump(target_mapping(target_sheet.target), sort_keys=False))
    click.echo(
        f"{describe_sheet(target_sheet)}, on {paper} ({target_sheet.width:g} x {target_sheet.height:g} mm)"
    )
    click.echo(f"to print: {out}   for --target: {yaml_file}")
