#!/usr/bin/env python3
"""Compares peak memory of making a photo, for several sizes, planes and tiles, with the bound in its report (`crates/pipeline/src/run/memory.rs`)."""
import argparse, json, os, random, subprocess, tempfile
from pathlib import Path
from common import PROGRAM, ROOT, Table, check, finish, noise, png, size_of, smooth


def blocks(megapixels, size):
    """Squares of `size` pixels, each with a random grey."""
    width, height = size_of(megapixels)
    rng = random.Random(1)
    lines = [b"".join(bytes([rng.randrange(1, 256)]) * size for _ in range(width // size + 1))[:width] for _ in range(height // size + 1)]
    return png(width, height, 1, (lines[y // size] for y in range(height)))


def eye(megapixels, second):
    """One picture of a stereo pair of noise; the upper half is farther away than the lower half."""
    (width, height), rng = size_of(megapixels), random.Random(1)
    most = max(4, width // 12)
    table = bytes(i % 2 * 255 for i in range(256))
    shifts = (most // 4 * second if y < height // 2 else most * second for y in range(height))
    return png(width, height, 3, (rng.randbytes(3 * (width + most)).translate(table)[3 * s : 3 * (s + width)] for s in shifts))


def cases(full):
    """Yields megapixels, photo, depth map or second picture, options."""
    raw = ["--denoise", "off", "--snap", "off", "--max-error", "0"]
    sizes = (0.003, 0.1, 0.5, 2, 6, 12, 24, 49.9) if full else (0.003, 0.1, 0.5, 2)
    for mp in sizes:
        yield from ((mp, "noise", None, []), (mp, "smooth", "smooth", []), (mp, "noise", "noise", []), (mp, "eye", "second", []))
        if full or mp <= 0.5:
            yield mp, "noise", "noise", raw
        # views with and without pruned texels, and the networks that denoise maps and refine layers
        for depth in ("smooth", "noise"):
            for more in (["--verify-prune"], ["--denoise", "theta"], ["--refine", "on"]):
                yield mp, "noise", depth, more
        yield mp, "noise", 24, [*raw, "--verify-prune", "--refine", "on"]
    # planes of noise take the most time: a minute per megapixel or more
    small = 2 if full else 0.2
    wide, normal = "10,10,10", "0.03,0.03,0.03"
    for mp, tile, planes, box in ((small / 4, "8", "4", wide), (small, "16", "16", normal), (small, "64", "64", normal), (small, "256", "16", wide), (small, "full", "16", wide)):
        yield mp, "noise", "noise", [*raw, "--tile", tile, "--planes", planes, "--view-box", box]
    for size in (6, 24, 100):
        yield small, "noise", size, [*raw, "--view-box", wide]


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true", help="photos of up to 50 megapixels; takes hours")
    full = args.parse_args().full
    environment = {"TMPI_MODELS": str(ROOT / "models"), **os.environ}
    table = Table("photo", "depth map", "options", "pixels", "planes per tile", "peak", "bytes per pixel", "bound", "peak / bound")
    with tempfile.TemporaryDirectory(prefix="tmpi-load-") as folder:
        folder = Path(folder)
        for mp, kind, depth, options in cases(full):
            (folder / "photo.png").write_bytes(noise(mp) if kind == "noise" else eye(mp, False) if kind == "eye" else smooth(mp))
            command = [PROGRAM, "make", "--force", str(folder / "photo.png"), "-o", str(folder / "out.tmpi"), "--report", str(folder / "r.json"), *options]
            if depth:
                levels = 16 if mp < 30 else 8
                made = eye(mp, True) if depth == "second" else smooth(mp, 1) if depth == "smooth" else noise(mp, 1, levels) if depth == "noise" else blocks(mp, depth)
                (folder / "depth.png").write_bytes(made)
                command += ["--second" if depth == "second" else "--depth", str(folder / "depth.png")]
            run = subprocess.run(command, capture_output=True, text=True, env=environment)
            if run.returncode:
                check(False, f"{mp} MP {kind} {depth} {options}: {run.stderr.strip()[-200:]}")
                continue
            report = json.loads((folder / "r.json").read_text())
            pixels = report["width"] * report["height"]
            bound, peak = report["memory_bound_bytes"], report["peak_rss_bytes"]
            check(peak <= bound, f"{mp} MP {kind} {depth} {options}: peak {peak} bytes, bound {bound}")
            name = f"blocks of {depth}" if isinstance(depth, int) else depth or "estimated"
            table.row(kind, name, " ".join(options), pixels, f"{report['planes_per_tile']:.2f}", f"{peak >> 20} MiB", f"{peak / pixels:.0f}", f"{bound / 2**20:.0f} MiB", f"{peak / bound:.2f}")
    finish()


main()
