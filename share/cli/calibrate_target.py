"""`share calibrate target`: a board to print."""

from __future__ import annotations

from pathlib import Path

import click

from share.errors import UsageError


@click.command(short_help="A board to print, and its YAML file.")
@click.option("--kind", type=click.Choice(["aprilgrid", "charuco"]), default="aprilgrid", show_default=True)
@click.option(
    "--paper", metavar="P", default="A4", show_default=True,
    help="A4 to A0, letter, tabloid, or WIDTHxHEIGHT in mm.",
)  # fmt: skip
@click.option("--columns", type=click.IntRange(1), metavar="N", help="Of tags or squares.  [default: 6, 9]")
@click.option("--rows", type=click.IntRange(1), metavar="N", help="The same.  [default: 6, 7]")
@click.option(
    "--size", type=click.FloatRange(0, min_open=True), metavar="MM",
    help="Of a tag's or square's edge.  [default: what fits, in whole mm]",
)  # fmt: skip
@click.option(
    "--out", required=True, metavar="B.pdf", type=click.Path(path_type=Path, dir_okay=False),
    help="The sheet; B.yaml comes beside it.",
)  # fmt: skip
def target(
    kind: str, paper: str, columns: int | None, rows: int | None, size: float | None, out: Path
) -> None:
    """Write a calibration board as a PDF, true to scale, and the YAML file by which other commands know it.

    Print at 100 % ("actual size"), glue it to something flat and stiff, and measure: where a tag's or
    square's edge is not what the sheet says, write into the YAML file what it is. A YAML file that is there
    and says something else is kept, and nothing printed.

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
        raise UsageError(f"--out {out}: expected a name that ends in .pdf")
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
            f"{yaml_file}: is of another board, or its size was mended, and is kept; give another --out, or "
            "move it away"
        )
    atomic_write(out, sheet_pdf(target_sheet))
    if not yaml_exists:
        atomic_write(yaml_file, yaml.safe_dump(target_mapping(target_sheet.target), sort_keys=False))
    click.echo(
        f"{describe_sheet(target_sheet)}, on {paper} ({target_sheet.width:g} x {target_sheet.height:g} mm)"
    )
    click.echo(f"print: {out}   for --target: {yaml_file}")
