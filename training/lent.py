"""Trains the depth network on a graphics card that is lent for minutes. README.md, "On a lent card", has the exact calls.

    python lent.py pack                # here: everything that the card's machine needs into runs/carry, and whether it is small enough
    python lent.py smoke               # there: speed by size of pictures, memory, share of the time that the card works, scenes a second, a measurement
    python lent.py run --minutes 9     # there: as many steps as fit; again: goes on
    python lent.py bring               # there: weights, log and manifest to $OUT; `run` does so by itself, and after every checkpoint
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

# what travels at most: tracked files, others that git does not ignore, and what is carried
MOST = 64 * 2**20
# a file that comes back at most
BACK = 16 * 2**20
# what comes back of a run, where it is there
BROUGHT = ("weights.pt", "last_weights.pt", "log.csv", "manifest.json", "run.log", "smoke.json")
# the program holds this file, which travels anyway
TWICE = MODELS / "depth.onnx"
# seconds that saving a checkpoint takes, and steps of a run that are left for what takes longer than was measured
SAVED, SPARE = 1.0, 0.03


def packed(a):
    """Fills the folder that travels."""
    a.carry.mkdir(parents=True, exist_ok=True)
    for path, hint in ((a.pack, "python pack.py"), (a.init, "a checkpoint, --init"), (a.program, "cargo build --release -p tmpi-lab, or --program"), (a.assets, "models, --assets")):
        if not Path(path).exists():
            raise SystemExit(f"{path} is not there: {hint}")
    shutil.copyfile(a.pack, a.carry / "pictures.zip")
    shutil.copyfile(a.init, a.carry / "start.pt")
    with tarfile.open(a.carry / "models.tar.xz", "w:xz") as tar:
        for model in sorted(Path(a.assets).rglob("*.glb")):
            tar.add(model, model.name)
    program = without_symbols(Path(a.program))
    at = program.find(TWICE.read_bytes())
    (a.carry / "program.xz").write_bytes(lzma.compress(program if at < 0 else program[:at] + program[at + TWICE.stat().st_size :]))
    (a.carry / "program.json").write_text(json.dumps({"at": at, "sha256": hashlib.sha256(program).hexdigest()}))
    sizes = {f.name: f.stat().st_size for f in sorted(a.carry.iterdir())}
    repository = travelling()
    for name, size in sizes.items() | {("the repository", repository)}:
        print(f"{size / 1e6:8.2f} MB  {name}")
    total = sum(sizes.values()) + repository
    print(f"{total / 1e6:8.2f} MB  of {MOST / 1e6:.2f}")
    if total > MOST:
        raise SystemExit("too much to travel: leave pictures out of pack.py, or models")


def without_symbols(program):
    """A program's bytes, without the names for a debugger where `strip` is there."""
    copy = RUNS / "stripped"
    RUNS.mkdir(exist_ok=True)
    shutil.copyfile(program, copy)
    with contextlib.suppress(FileNotFoundError):
        subprocess.run(["strip", copy], check=False, stderr=subprocess.DEVNULL)
    found = copy.read_bytes()
    copy.unlink()
    return found


def travelling():
    """Bytes of the repository's files that git does not ignore."""
    listed = subprocess.run(["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=HERE.parent, capture_output=True, check=True).stdout
    files = [HERE.parent / os.fsdecode(name) for name in listed.split(b"\0") if name]
    return sum(f.stat().st_size for f in files if f.is_file())


def unpacked(a):
    """The program and its models on the machine with the card."""
    program, models = a.work / "tmpi-lab", a.work / "models"
    if program.exists():
        return program, models
    a.work.mkdir(parents=True, exist_ok=True)
    with tarfile.open(a.carry / "models.tar.xz") as tar:
        tar.extractall(models, filter="data")
    told, found = json.loads((a.carry / "program.json").read_text()), lzma.decompress((a.carry / "program.xz").read_bytes())
    if told["at"] >= 0:
        found = found[: told["at"]] + TWICE.read_bytes() + found[told["at"] :]
    if hashlib.sha256(found).hexdigest() != told["sha256"]:
        raise SystemExit(f"the program is not the one that was packed: has {TWICE} changed?")
    program.write_bytes(found)
    program.chmod(0o755)
    return program, models


def options(a, **more):
    """The words of depth.py's command line."""
    program, models = unpacked(a)
    words = {"pack": a.carry / "pictures.zip", "init": a.carry / "start.pt", "device": a.device, "batch": a.batch, "out": a.work / "run"}
    words |= {"renderers": a.renderers, "program": program, "models": models} if a.renderers else {}
    return [str(w) for k, v in (words | more).items() for w in (f"--{k}", v)]


class Watch:
    """How busy the card is meanwhile, by `nvidia-smi`."""

    def __init__(self, device):
        line = ["nvidia-smi", "--query-gpu=utilization.gpu,memory.used,power.draw", "--format=csv,noheader,nounits", "-lms", "250"]
        self.process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True) if device == "cuda" and shutil.which("nvidia-smi") else None

    def told(self):
        """Means of the share of the time in which it works [%], memory [MiB], power [W]; nothing without a card."""
        if self.process is None:
            return []
        self.process.terminate()
        rows = [[float(v) for v in line.split(",")] for line in self.process.communicate()[0].splitlines() if line.count(",") == 2 and "N/A" not in line]
        return [sum(column) / len(rows) for column in zip(*rows)]


def usual_shapes():
    """The shape that is drawn most of each size of pictures, and how often the size is drawn."""
    least, found = min(h * w for h, w in batches.SHAPES), {}
    for shape, often in sorted(batches.SHAPES.items(), key=lambda s: -s[1]):
        size = round(2 * math.prod(shape) / least) / 2
        usual, before = found.get(size, (shape, 0.0))
        found[size] = usual, before + often
    return found.values()


def timed(run, learner, shape, seconds):
    """Seconds a step of one shape, after two that are not counted."""
    whole, step, start = run.pictures.batch, 0, 0.0
    run.pictures.batch = lambda count, rng: whole(count, rng, shape)
    try:
        while step < 5 or time.time() - start < seconds:
            if step == 2:
                waited(run.device)
                start = time.time()
            run.net.train()
            learner.learn(run.steps.loss_at(run.plan.warm + step)["loss"], run.plan.warm + step)
            step += 1
        waited(run.device)
    finally:
        del run.pictures.batch
    return (time.time() - start) / (step - 2)


def waited(device):
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def waits(run, learner):
    """Places at which three steps wait for the card."""
    if run.device.type != "cuda":
        return []
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        for step in range(3):
            learner.learn(run.steps.loss_at(run.plan.warm + step)["loss"], run.plan.warm + step)
        torch.cuda.set_sync_debug_mode("default")
    return sorted({f"{Path(w.filename).name}:{w.lineno}" for w in told if "synchronizing" in str(w.message)})


def smoked(a):
    """Measures what a run would be, and writes it to smoke.json."""
    began = time.time()
    run = depth.Run(depth.arguments().parse_args([*options(a, out=a.work / "smoke"), "--steps", "1000"]))
    try:
        found = {"torch": torch.__version__, "card": torch.cuda.get_device_name() if run.device.type == "cuda" else "none", "start": time.time() - began}
        torch.set_num_threads(a.threads)
        run.choice(run.mean)
        since = time.time()
        figures, found["choice"] = run.choice(run.mean), time.time() - since
        learner = loop.Learner(run.net, run.plan, run.mean, run.slow, run.args.gain)
        # what a step makes ready the first time
        timed(run, learner, next(iter(batches.SHAPES)), 0)
        scenes, since, watch = run.pictures.count("scene"), time.time(), Watch(run.device.type)
        left = max(0.0, a.seconds - (since - began))
        shapes = {f"{h}x{w}": (timed(run, learner, (h, w), left / 3), often) for (h, w), often in usual_shapes()}
        found |= {"busy": watch.told(), "scenes": (run.pictures.count("scene") - scenes) / (time.time() - since)}
        found |= {"steps": {k: 1 / v for k, (v, _) in shapes.items()}, "step": sum(v * often for v, often in shapes.values())}
        found |= {"memory": torch.cuda.max_memory_allocated() / 2**30 if run.device.type == "cuda" else 0.0, "waits": waits(run, learner), "figures": figures}
    finally:
        run.close()
    (a.work / "smoke.json").write_text(json.dumps(found, indent=1))
    print(json.dumps(found, indent=1), flush=True)
    bring(a)
    return found


def fitted(told, minutes, every):
    """Steps that fit into the minutes of one run, by what was measured."""
    seconds = 60 * minutes - told["start"] - told["choice"] - SAVED
    return max(1, int((1 - SPARE) * seconds / (told["step"] + (told["choice"] + SAVED) / every)))


def trained(a):
    """One run, or the next part of it; its checkpoints are brought while it goes on."""
    plan, began = a.work / "plan.json", time.time()
    if not plan.exists():
        smoke = a.work / "smoke.json"
        told = json.loads(smoke.read_text()) if smoke.exists() else smoked(a)
        minutes = (a.of or a.minutes) - (time.time() - began) / 60
        plan.write_text(json.dumps({"steps": fitted(told, minutes, a.every), "every": a.every}))
    words = options(a, **json.loads(plan.read_text()), threads=a.threads)
    left = a.minutes - (time.time() - began) / 60 - SAVED / 60
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
    """Copies what came of a run to `a.out`, as whole files."""
    a.out.mkdir(parents=True, exist_ok=True)
    for name in BROUGHT:
        source, target = (a.work / "run" / name if (a.work / "run" / name).exists() else a.work / name), a.out / name
        if not source.exists() or (target.exists() and target.stat().st_mtime >= source.stat().st_mtime):
            continue
        if source.stat().st_size > BACK:
            print(f"{name} is too large to come back: {source.stat().st_size} bytes")
            continue
        part = target.with_name(f"{name}.part")
        shutil.copyfile(source, part)
        part.replace(target)


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("stage", choices=["pack", "smoke", "run", "bring"])
    a.add_argument("--carry", type=Path, default=RUNS / "carry", help="what travels")
    a.add_argument("--work", type=Path, default=RUNS / "lent", help="folder on the machine with the card")
    a.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", RUNS / "brought")), help="what comes back")
    a.add_argument("--pack", type=Path, default=pack.FILE)
    a.add_argument("--init", type=Path, default=DATA / "pretrained" / "depth_lite2.pt", help="checkpoint to begin with")
    a.add_argument("--program", type=Path, default=HERE.parent / "target" / "release" / "tmpi-lab", help="what renders")
    a.add_argument("--assets", type=Path, default=DATA / "train2" / "assets", help="folder of models, at any depth")
    a.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    a.add_argument("--renderers", type=int, default=max(1, (os.cpu_count() or 2) - 3))
    a.add_argument("--batch", type=int, default=96)
    a.add_argument("--threads", type=int, default=2)
    a.add_argument("--seconds", type=float, default=45, help="of `smoke`, its start included")
    a.add_argument("--minutes", type=float, default=9, help="of `run`, its start included")
    a.add_argument("--of", type=float, help="minutes of this `run` and of those that go on with it: over these the rate falls")
    a.add_argument("--every", type=int, default=250, help="steps between checkpoints")
    a = a.parse_args()
    {"pack": packed, "smoke": smoked, "run": trained, "bring": bring}[a.stage](a)


if __name__ == "__main__":
    main()
