#!/usr/bin/env python3
"""Makes six photos, and computes the figures of their reports again from what the program writes: the view from the photo's own place, and the
planes and layers of the exported archive."""
import io, json, math, struct, subprocess, tempfile, zipfile, zlib
from pathlib import Path
from common import PROGRAM, Table, check, finish, png


def read_png(data):
    """Width, height, samples per pixel, and rows of an 8-bit PNG."""
    width, height, _, colour = struct.unpack(">IIBB", data[16:26])
    channels, body, at = {0: 1, 2: 3, 4: 2, 6: 4}[colour], [], 8
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body += [data[at + 8 : at + 8 + length]] if kind == b"IDAT" else []
        at += length + 12
    raw, line, above, rows = zlib.decompress(b"".join(body)), width * channels, bytes(width * channels), []
    for y in range(height):
        kind, row = raw[y * (line + 1)], bytearray(raw[y * (line + 1) + 1 : (y + 1) * (line + 1)])
        if kind == 2:
            row = bytearray((a + b) & 255 for a, b in zip(row, above))
        elif kind:
            for i in range(line):
                left, up = row[i - channels] if i >= channels else 0, above[i]
                corner = above[i - channels] if i >= channels else 0
                guess = left + up - corner
                nearest = min((abs(guess - v), n, v) for n, v in enumerate((left, up, corner)))[2]
                row[i] = (row[i] + {1: left, 3: (left + up) // 2, 4: nearest}[kind]) & 255
        rows.append(row)
        above = row
    return width, height, channels, rows


def psnr(squares, values):
    return 10 * math.log10(255**2 * values / squares) if squares else 99.0


def apart(k, box, x, y, a, b):
    """Distance in pixels between a point at two disparities, from the corner of the view box where it is largest."""
    most = 0.0
    for i in range(8):
        tx, ty, tz = (side if i >> bit & 1 else -side for bit, side in enumerate((box["x"], box["y"], box["z"])))
        at = lambda d: ((x - k["cx"] - k["fx"] * tx * d) / (1 - tz * d), (y - k["cy"] - k["fy"] * ty * d) / (1 - tz * d))
        (ax, ay), (bx, by) = at(a), at(b)
        most = max(most, abs(ax - bx), abs(ay - by))
    return most


def planes(archive, depth, every, creased):
    """Errors of the planes of one in `every` tiles against the map, in disparity and in pixels; the mean in pixels of each tile; counts."""
    about = json.loads(archive.read("planes.json"))
    k, box, half = about["intrinsics"], about["view_box"], about["tile"]["half"]
    texels, whole, sums, tiles, of_tile = 0, 0, [0.0, 0.0, 0.0, 0], {}, {}
    for layer in about["layers"]:
        of_tile.setdefault(layer["tile"], []).append(layer)
        r = about["tiles"][layer["tile"]]["rect"]
        whole += r["w"] * r["h"]
    for index, layers in of_tile.items():
        # the nearest opaque texel is what shows; at creases that is the rim of another layer, and the plane closest to the map is meant
        better = (lambda x, y, d, other: abs(d - depth(x, y)) < abs(other - depth(x, y))) if creased else (lambda x, y, d, other: d > other)
        shown = {}
        tile = about["tiles"][index]
        for layer in layers:
            width, height, channels, rows = read_png(archive.read(layer["file"]))
            plane, r = layer["plane"], layer["rect"]
            for j in range(height):
                alphas = rows[j][3::4] if channels == 4 else b"\xff" * width
                texels += sum(1 for a in alphas if a)
                if index % every == 0:
                    for i in (i for i, a in enumerate(alphas) if a == 255):
                        x, y = r["x"] + i, r["y"] + j
                        d = plane["a"] + plane["b"] * (x + 0.5 - tile["centre"][0]) / half + plane["c"] * (y + 0.5 - tile["centre"][1]) / half
                        if (x, y) not in shown or better(x, y, d, shown[x, y]):
                            shown[x, y] = d
        if shown:
            px = 0.0
            for (x, y), d in shown.items():
                known = depth(x, y)
                here = apart(k, box, x + 0.5, y + 0.5, d, known) if d != known else 0.0
                px += here
                for n, v in enumerate((abs(d - known), (d - known) ** 2, here, 1)):
                    sums[n] += v
            tiles[index] = px / len(shown)
    return [v / sums[3] for v in sums[:3]], tiles, texels, whole, len(about["layers"])


def photos():
    """Name, size, depth in 0 to 255 at a pixel, disparity that it stands for, options."""
    noise = lambda x, y: (x * 7919 + y * 104729 + x * y * 31) % 997 / 997
    plain = lambda value: lambda x, y: value(x, y) / 255
    stairs = lambda x, y: 25 + 51 * ((x // 50 + y // 40) % 5)
    zigzag = lambda x, y: 51 * abs((x + y) % 10 - 5)
    noisy = lambda x, y: int(100 + 25 * noise(x, y))
    # metric: a twentieth is unknown, and takes the farther of its neighbours in the row
    metric = lambda x, y: 0 if x % 20 == 7 else 60 + x
    held = lambda x, y: 60 / metric(x + 1 if metric(x, y) == 0 else x, y)
    yield "flat", (200, 150), lambda x, y: 128, plain(lambda x, y: 128), []
    yield "noisy depth", (200, 150), noisy, plain(noisy), ["--view-box", "0.119,0.05,0.2"]
    yield "zigzag", (300, 200), zigzag, plain(zigzag), ["--max-error", "0.2"]
    yield "holes", (180, 120), metric, held, ["--depth-kind", "metric"]
    yield "12 MP", (4000, 3000), stairs, plain(stairs), []
    yield "budgeted", (900, 600), stairs, plain(stairs), ["--budget-ms", "1000"]


def colour(x, y):
    return int(127.5 + 100 * math.sin(x / 9)), int(127.5 + 100 * math.sin(y / 7)), 200 if (x // 30 + y // 20) % 2 else 90


def figures(folder, name, size, value, disparity, options):
    (width, height), pixel = size, [[colour(x, y) for x in range(size[0])] for y in range(size[1])]
    (folder / "photo.png").write_bytes(png(width, height, 3, (bytes(v for p in row for v in p) for row in pixel)))
    (folder / "depth.png").write_bytes(png(width, height, 1, (bytes(value(x, y) for x in range(width)) for y in range(height))))
    made, report = folder / "photo.tmpi", folder / "report.json"
    run = lambda *args: subprocess.run([PROGRAM, *map(str, args)], check=True, capture_output=True)
    run("make", "--force", folder / "photo.png", "--depth", folder / "depth.png", "-o", made, "--report", report, "--denoise", "off", "--snap", "off", *options)
    run("render", made, "-o", folder / "view.png", "--backend", "reference")
    run("export", made, "-o", folder / "parts.zip")
    report = json.loads(report.read_text())
    if not check((report["width"], report["height"]) == size, f"{name}: {report['width']}×{report['height']}"):
        return
    error, large = report["error"], width * height > 2_000_000
    with zipfile.ZipFile(folder / "parts.zip") as archive:
        (mae, mse, px), tiles, texels, whole, layers = planes(archive, disparity, 40 if large else 1, name == "zigzag")
    _, _, channels, rows = read_png((folder / "view.png").read_bytes())
    squares = sum((a - b) ** 2 for row, line in zip(rows, pixel) for c in range(3) for a, b in zip(row[c::channels], (p[c] for p in line)))
    all_rows = error["identity_tiles"] == report["tiles"]
    # a sample of tiles, or of rows, is close; single pixels of noise show the rims of others
    near = 0.3 if large else 0.05
    yield "identity_psnr", error["identity_psnr"], psnr(squares, 3 * width * height), 1e-3 if all_rows else 0.7
    yield "depth_mae", error["depth_mae"], mae, near * mae + 1e-6
    yield "depth_mse", error["depth_mse"], mse, near * mse + 1e-12
    yield "planes.mean_px", error["planes"]["mean_px"], px, near * px + 1e-4
    yield "tile_px, mean of tiles", sum(error["tile_px"][t] for t in tiles) / len(tiles), sum(tiles.values()) / len(tiles), 0.02 * px + 1e-3
    yield "planes", report["planes"], layers, 0
    yield "texels", report["texels"], texels, 0
    yield "left_out.texels", report["left_out"]["texels"], whole - texels, 0
    if name == "holes":
        count = sum(value(x, y) == 0 for y in range(height) for x in range(width))
        yield "depth_filled", error["depth_filled"], count / (width * height), 1e-9


def main():
    table, told = Table("photo", "figure", "reported", "computed"), {}
    with tempfile.TemporaryDirectory(prefix="tmpi-load-") as folder:
        for photo in photos():
            for figure, reported, computed, slack in figures(Path(folder), *photo):
                table.row(photo[0], figure, f"{reported:.6g}", f"{computed:.6g}")
                check(abs(reported - computed) <= slack, f"{photo[0]}: {figure} is {reported}, computed as {computed}")
                told.setdefault(figure, False)
                told[figure] |= all(abs(by * reported - computed) > slack for by in (0.5, 2))
    for figure, is_told in told.items():
        check(is_told, f"{figure} may be twice or half as large in each photo")
    finish()


main()
