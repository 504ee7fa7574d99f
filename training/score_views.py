#!/usr/bin/env python3
"""Novel views against exact second views of rendered scenes: what an option of `tmpi make` gains and costs.

usage: score_views.py [--bin target/release/tmpi] [--count 24] [--seed 900000] -- "" "--refine on" "--planes 4 --plane-method lloyd" ...

Each argument after `--` is one set of options; a row each: PSNR, SSIM (11x11 Gaussian, sigma 1.5) and L1 over the view less 15 % on
each side, planes a tile, bytes and milliseconds. Photo and exact disparity go in, the view comes out at the second camera's pose.
"""
import argparse, json, pathlib, shlex, subprocess, tempfile
import cv2
import numpy as np


def score(a, b):
    h, w = a.shape[:2]
    y, x = int(h * 0.15), int(w * 0.15)
    a, b = (v[y:h - y, x:w - x].astype(np.float64) / 255 for v in (a, b))
    g = lambda v: cv2.GaussianBlur(v, (11, 11), 1.5)
    ma, mb = g(a), g(b)
    va, vb, cov = g(a * a) - ma * ma, g(b * b) - mb * mb, g(a * b) - ma * mb
    ssim = ((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))).mean()
    return 10 * np.log10(1 / max(((a - b) ** 2).mean(), 1e-12)), ssim, abs(a - b).mean()


def run(*command):
    subprocess.run([str(c) for c in command], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def measure(binary, scene, options, out):
    about = json.loads((scene / "scene.json").read_text())
    box = [max(abs(v["pose"][k]) for v in about["views"]) for k in ("tx", "ty", "tz")]
    run(binary, "make", scene / "photo.png", "--depth", scene / "disparity.png", "--fov-x", about["fov_x"],
        "--view-box", ",".join(map(str, box)), "-o", out / "o.tmpi", "--report", out / "r.json", *options)
    report = json.loads((out / "r.json").read_text())
    rows = []
    for view in about["views"]:
        pose = ",".join(str(view["pose"][k]) for k in ("tx", "ty", "tz", "yaw", "pitch", "roll"))
        run(binary, "render", out / "o.tmpi", "-o", out / "v.png", f"--pose={pose}", "--backend", "cpu")
        rows.append(score(cv2.imread(str(out / "v.png")), cv2.imread(str(scene / view["photo"]))))
    return [*np.mean(rows, 0), report["planes_per_tile"], report["bytes"]["total"], report["total_ms"]]


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--bin", default="target/release/tmpi")
    p.add_argument("--count", type=int, default=24)
    p.add_argument("--seed", type=int, default=900000)
    p.add_argument("options", nargs="*", default=["", "--refine on"])
    a = p.parse_args()
    with tempfile.TemporaryDirectory() as t:
        t = pathlib.Path(t)
        run(a.bin, "synth", "-o", t / "scenes", "--count", a.count, "--seed", a.seed, "--views", 2)
        scenes = sorted(d for d in (t / "scenes").iterdir() if d.is_dir())
        for options in a.options:
            r = np.mean([measure(a.bin, s, shlex.split(options), t) for s in scenes], 0)
            print("%-40s PSNR %.2f  SSIM %.4f  L1 %.4f  planes/tile %.2f  %7d B  %5.0f ms" % (options or "(defaults)", *r), flush=True)


if __name__ == "__main__":
    main()
