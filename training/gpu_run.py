"""Trains the depth network in minutes on a borrowed GPU machine. README.md, "A short run on a GPU machine", has the exact calls.

    python gpu_run.py pack                # here: collects everything for the GPU machine in runs/carry, and checks the size
    python gpu_run.py smoke               # there: measures speed by picture size, memory, GPU utilisation, scenes per second, and a measurement
    python gpu_run.py run --minutes 9     # there: as many steps as fit; a second call resumes
    python gpu_run.py bring               # there: copies weights, log and manifest to $OUT; `run` does so after every checkpoint
"""

import argparse
import contextlib
import hashlib
import json
import lzma
import math
import os
import shutil
import subprocess
import sys
import tarfile
import time
import warnings
from pathlib import Path

import torch

import batches
import depth
import loop
import pack
from paths import DATA, HERE, MODELS, RUNS

# upload limit: tracked files, untracked files that git does not ignore, and the carry folder
MAX_UPLOAD = 64 * 2**20
# size limit of a returned file
MAX_RESULT = 16 * 2**20
# files of a run to return, if they exist
RESULTS = ("weights.pt", "last_weights.pt", "log.csv", "manifest.json", "run.log", "smoke.json")
# the program embeds this file, which the repository contains anyway
EMBEDDED = MODELS / "depth.onnx"
# seconds to save a checkpoint, and fraction of steps kept in reserve
SAVE_SECONDS, RESERVE = 1.0, 0.03


def pack_files(a):
    """Fills the carry folder."""
    a.carry.mkdir(parents=True, exist_ok=True)
    for path, hint in ((a.pack, "python pack.py"), (a.init, "a checkpoint, --init"), (a.program, "cargo build --release -p tmpi-lab, or --program"), (a.assets, "models, --assets")):
        if not Path(path).exists():
            raise SystemExit(f"{path} does not exist: {hint}")
    shutil.copyfile(a.pack, a.carry / "pictures.zip")
    shutil.copyfile(a.init, a.carry / "start.pt")
    with tarfile.open(a.carry / "models.tar.xz", "w:xz") as tar:
        for model in sorted(Path(a.assets).rglob("*.glb")):
            tar.add(model, model.name)
    program = without_symbols(Path(a.program))
    at = program.find(EMBEDDED.read_bytes())
    (a.carry / "program.xz").write_bytes(lzma.compress(program if at < 0 else program[:at] + program[at + EMBEDDED.stat().st_size :]))
    (a.carry / "program.json").write_text(json.dumps({"at": at, "sha256": hashlib.sha256(program).hexdigest()}))
    sizes = {f.name: f.stat().st_size for f in sorted(a.carry.iterdir())}
    repository = repository_size()
    for name, size in sizes.items() | {("the repository", repository)}:
        print(f"{size / 1e6:8.2f} MB  {name}")
    total = sum(sizes.values()) + repository
    print(f"{total / 1e6:8.2f} MB  of {MAX_UPLOAD / 1e6:.2f}")
    if total > MAX_UPLOAD:
        raise SystemExit("too large: omit pictures in pack.py, or models")


def without_symbols(program):
    """A program's bytes, without debug symbols if `strip` is installed."""
    copy = RUNS / "stripped"
    RUNS.mkdir(exist_ok=True)
    shutil.copyfile(program, copy)
    with contextlib.suppress(FileNotFoundError):
        subprocess.run(["strip", copy], check=False, stderr=subprocess.DEVNULL)
    stripped = copy.read_bytes()
    copy.unlink()
    return stripped


def repository_size():
    """Size in bytes of the repository's files that git does not ignore."""
    listed = subprocess.run(["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=HERE.parent, capture_output=True, check=True).stdout
    files = [HERE.parent / os.fsdecode(name) for name in listed.split(b"\0") if name]
    return sum(f.stat().st_size for f in files if f.is_file())


def unpack_files(a):
    """Unpacks program and models on the GPU machine."""
    program, models = a.work / "tmpi-lab", a.work / "models"
    if program.exists():
        return program, models
    a.work.mkdir(parents=True, exist_ok=True)
    with tarfile.open(a.carry / "models.tar.xz") as tar:
        tar.extractall(models, filter="data")
    meta, binary = json.loads((a.carry / "program.json").read_text()), lzma.decompress((a.carry / "program.xz").read_bytes())
    if meta["at"] >= 0:
        binary = binary[: meta["at"]] + EMBEDDED.read_bytes() + binary[meta["at"] :]
    if hashlib.sha256(binary).hexdigest() != meta["sha256"]:
        raise SystemExit(f"the program differs from the packed one: has {EMBEDDED} changed?")
    program.write_bytes(binary)
    program.chmod(0o755)
    return program, models


def options(a, **more):
    """Command-line arguments for depth.py."""
    program, models = unpack_files(a)
    words = {"pack": a.carry / "pictures.zip", "init": a.carry / "start.pt", "device": a.device, "batch": a.batch, "out": a.work / "run"}
    words |= {"renderers": a.renderers, "program": program, "models": models} if a.renderers else {}
    return [str(w) for k, v in (words | more).items() for w in (f"--{k}", v)]


class Watch:
    """Records GPU utilisation with `nvidia-smi`."""

    def __init__(self, device):
        line = ["nvidia-smi", "--query-gpu=utilization.gpu,memory.used,power.draw", "--format=csv,noheader,nounits", "-lms", "250"]
        self.process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True) if device == "cuda" and shutil.which("nvidia-smi") else None

    def means(self):
        """Mean utilisation [%], memory [MiB] and power [W]; empty without a GPU."""
        if self.process is None:
            return []
        self.process.terminate()
        rows = [[float(v) for v in line.split(",")] for line in self.process.communicate()[0].splitlines() if line.count(",") == 2 and "N/A" not in line]
        return [sum(column) / len(rows) for column in zip(*rows)]


def usual_shapes():
    """The most frequent shape of each picture size, and the probability of the size."""
    least, found = min(h * w for h, w in batches.SHAPES), {}
    for shape, often in sorted(batches.SHAPES.items(), key=lambda s: -s[1]):
        size = round(2 * math.prod(shape) / least) / 2
        usual, before = found.get(size, (shape, 0.0))
        found[size] = usual, before + often
    return found.values()


def seconds_per_step(run, learner, shape, seconds):
    """Seconds per step for one shape, after two warm-up steps."""
    whole, step, start = run.pictures.batch, 0, 0.0
    run.pictures.batch = lambda count, rng: whole(count, rng, shape)
    try:
        while step < 5 or time.time() - start < seconds:
            if step == 2:
                synchronise(run.device)
                start = time.time()
            run.net.train()
            learner.learn(run.steps.loss_at(run.plan.warm + step)["loss"], run.plan.warm + step)
            step += 1
        synchronise(run.device)
    finally:
        del run.pictures.batch
    return (time.time() - start) / (step - 2)


def synchronise(device):
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def waits(run, learner):
    """Source lines at which three steps wait for the GPU."""
    if run.device.type != "cuda":
        return []
    with warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        for step in range(3):
            learner.learn(run.steps.loss_at(run.plan.warm + step)["loss"], run.plan.warm + step)
        torch.cuda.set_sync_debug_mode("default")
    return sorted({f"{Path(w.filename).name}:{w.lineno}" for w in recorded if "synchronizing" in str(w.message)})


def smoke(a):
    """Measures the speed of a run, and writes smoke.json."""
    began = time.time()
    run = depth.Run(depth.arguments().parse_args([*options(a, out=a.work / "smoke"), "--steps", "1000"]))
    try:
        found = {"torch": torch.__version__, "card": torch.cuda.get_device_name() if run.device.type == "cuda" else "none", "start": time.time() - began}
        torch.set_num_threads(a.threads)
        run.choice(run.mean)
        since = time.time()
        figures, found["choice"] = run.choice(run.mean), time.time() - since
        learner = loop.Learner(run.net, run.plan, run.mean, run.slow, run.args.gain)
        # warm-up
        seconds_per_step(run, learner, next(iter(batches.SHAPES)), 0)
        scenes, since, watch = run.pictures.count("scene"), time.time(), Watch(run.device.type)
        left = max(0.0, a.seconds - (since - began))
        shapes = {f"{h}x{w}": (seconds_per_step(run, learner, (h, w), left / 3), often) for (h, w), often in usual_shapes()}
        found |= {"busy": watch.means(), "scenes": (run.pictures.count("scene") - scenes) / (time.time() - since)}
        found |= {"steps": {k: 1 / v for k, (v, _) in shapes.items()}, "step": sum(v * often for v, often in shapes.values())}
        found |= {"memory": torch.cuda.max_memory_allocated() / 2**30 if run.device.type == "cuda" else 0.0, "waits": waits(run, learner), "figures": figures}
    finally:
        run.close()
    (a.work / "smoke.json").write_text(json.dumps(found, indent=1))
    print(json.dumps(found, indent=1), flush=True)
    bring(a)
    return found


def steps_that_fit(measured, minutes, every):
    """Number of steps that fit into the minutes of one run, from measured times."""
    seconds = 60 * minutes - measured["start"] - measured["choice"] - SAVE_SECONDS
    return max(1, int((1 - RESERVE) * seconds / (measured["step"] + (measured["choice"] + SAVE_SECONDS) / every)))


def run_training(a):
    """Starts or resumes a run; returns checkpoints during the run."""
    plan, began = a.work / "plan.json", time.time()
    if not plan.exists():
        report = a.work / "smoke.json"
        measured = json.loads(report.read_text()) if report.exists() else smoke(a)
        minutes = (a.of or a.minutes) - (time.time() - began) / 60
        plan.write_text(json.dumps({"steps": steps_that_fit(measured, minutes, a.every), "every": a.every}))
    words = options(a, **json.loads(plan.read_text()), threads=a.threads)
    left = a.minutes - (time.time() - began) / 60 - SAVE_SECONDS / 60
    command = [sys.executable, "-u", str(HERE / "depth.py"), *words, "--minutes", f"{left:.3f}"]
    print(" ".join(command), flush=True)
    with open(a.work / "run.log", "ab") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(2)
                bring(a)
        finally:
            if process.poll() is None:
                process.terminate()
    print((a.work / "run.log").read_text()[-4000:])
    bring(a)
    if process.returncode:
        raise SystemExit(process.returncode)


def bring(a):
    """Copies results of a run to `a.out` atomically."""
    a.out.mkdir(parents=True, exist_ok=True)
    for name in RESULTS:
        source, target = (a.work / "run" / name if (a.work / "run" / name).exists() else a.work / name), a.out / name
        if not source.exists() or (target.exists() and target.stat().st_mtime >= source.stat().st_mtime):
            continue
        if source.stat().st_size > MAX_RESULT:
            print(f"{name} is too large to return: {source.stat().st_size} bytes")
            continue
        part = target.with_name(f"{name}.part")
        shutil.copyfile(source, part)
        part.replace(target)


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("stage", choices=["pack", "smoke", "run", "bring"])
    a.add_argument("--carry", type=Path, default=RUNS / "carry", help="folder to copy to the GPU machine")
    a.add_argument("--work", type=Path, default=RUNS / "gpu", help="folder on the GPU machine")
    a.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", RUNS / "brought")), help="folder for results")
    a.add_argument("--pack", type=Path, default=pack.FILE)
    a.add_argument("--init", type=Path, default=DATA / "pretrained" / "depth_lite2.pt", help="checkpoint to start from")
    a.add_argument("--program", type=Path, default=HERE.parent / "target" / "release" / "tmpi-lab", help="program that renders")
    a.add_argument("--assets", type=Path, default=DATA / "train2" / "assets", help="folder of models, at any depth")
    a.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    a.add_argument("--renderers", type=int, default=max(1, (os.cpu_count() or 2) - 3))
    a.add_argument("--batch", type=int, default=96)
    a.add_argument("--threads", type=int, default=2)
    a.add_argument("--seconds", type=float, default=45, help="duration of `smoke`, including its start")
    a.add_argument("--minutes", type=float, default=9, help="duration of `run`, including its start")
    a.add_argument("--of", type=float, help="total minutes of this `run` and of those that resume it; the learning rate falls over them")
    a.add_argument("--every", type=int, default=250, help="steps between checkpoints")
    a = a.parse_args()
    {"pack": pack_files, "smoke": smoke, "run": run_training, "bring": bring}[a.stage](a)


if __name__ == "__main__":
    main()
