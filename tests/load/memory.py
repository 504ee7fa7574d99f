#!/usr/bin/env python3
"""Peak memory of making a photo, by size, planes and tiles, against the formula in `crates/pipeline/src/run/memory.rs`."""
import argparse, json, os, random, subprocess, tempfile
from pathlib import Path
from common import PROGRAM, Table, check, end, noise, png, size_of, smooth

BASE, PIXEL, PLANE, LAYER = 80 << 20, 32, 14, 1200


def blocks(megapixels, size):
    width, height = size_of(megapixels)
    pick = random.Random(1)
    lines = [b"".join(bytes([pick.randrange(1, 256)]) * size for _ in range(width // size + 1))[:width] for _ in range(height // size + 1)]
    return png(width, height, 1, (lines[y // size] for y in range(height)))


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    sizes = (0.5, 2, 6, 12, 24, 49.9) if full else (0.5, 2)
    raw = ["--denoise", "off", "--snap", "off", "--max-error", "0"]
    cases = []
    for mp in sizes:
        cases += [(mp, "noise", None, []), (mp, "smooth", "smooth", []), (mp, "noise", "noise", []), (mp, "noise", "noise", raw)]
    for mp, tile, planes, box in ((0.5, "8", "4", "10,10,10"), (2, "16", "16", "0.03,0.03,0.03"), (2, "64", "64", "0.03,0.03,0.03"), (2, "256", "16", "10,10,10"), (2, "full", "16", "10,10,10")):
        cases.append((mp, "noise", "noise", [*raw, "--tile", tile, "--planes", planes, "--view-box", box]))
    for size in (6, 24, 100):
        cases.append((2, "noise", size, [*raw, "--view-box", "10,10,10"]))
    table = Table("photo", "map", "options", "pixels", "planes a tile", "peak", "bytes a pixel", "formula", "share")
    with tempfile.TemporaryDirectory(prefix="tmpi-load-") as folder:
        folder = Path(folder)
        for mp, kind, depth, options in cases:
            (folder / "photo.png").write_bytes(noise(mp) if kind == "noise" else smooth(mp))
            command = [PROGRAM, "make", "--force", str(folder / "photo.png"), "-o", str(folder / "out.tmpi"), "--report", str(folder / "r.json"), *options]
            if depth:
                levels = 16 if mp < 30 else 8
                made = smooth(mp, 1) if depth == "smooth" else noise(mp, 1, levels) if depth == "noise" else blocks(mp, depth)
                (folder / "depth.png").write_bytes(made)
                command += ["--depth", str(folder / "depth.png")]
            run = subprocess.run(command, capture_output=True, text=True)
            if run.returncode:
                check(False, f"{mp} MP {kind} {depth} {options}: {run.stderr.strip()[-200:]}")
                continue
            report = json.loads((folder / "r.json").read_text())
            pixels = report["width"] * report["height"]
            layers = report["planes_per_tile"] + 1
            formula = BASE + pixels * (PIXEL + PLANE * layers) + report["tiles"] * layers * LAYER
            peak = report["peak_rss_bytes"]
            check(peak <= formula, f"{mp} MP {kind} {depth} {options}: {peak} bytes, the formula says {formula:.0f}")
            name = f"blocks of {depth}" if isinstance(depth, int) else depth or "estimated"
            table.row(kind, name, " ".join(options), pixels, f"{report['planes_per_tile']:.2f}", f"{peak >> 20} MiB", f"{peak / pixels:.0f}", f"{formula / 2**20:.0f} MiB", f"{peak / formula:.2f}")
    end()


main()
