"""The training loop of all three networks, which depends only on steps and resumes bit for bit.

Learning rate, batch shape and batch contents are functions of seed and step. All other randomness (dropout, mixed statistics) comes from the generators
of PyTorch, NumPy and Python, which are seeded at the start and saved with every checkpoint. A resumed run therefore ends with the same bits as an
uninterrupted one, on the same machine with the same number of threads.
"""

import copy
import csv
import hashlib
import math
import random
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

import run_record


# steps between printed lines with loss and speed
PRINT_EVERY = 50


@dataclass(frozen=True)
class Plan:
    """Parameters of a run besides network and data; a changed plan needs a new run."""

    steps: int
    lr: float  # highest learning rate
    weight_decay: float
    ema: float  # decay of the weight average
    every: int  # steps between rows of the log, measurements and checkpoints
    seed: int
    threads: int = 1
    warm: int = 50  # warm-up steps of the learning rate


class Changed(SystemExit):
    """A run cannot resume, because its plan, options or input files changed."""


def rate(plan, step):
    """Learning rate of a step: warm-up, then half a cosine down to a hundredth."""
    return plan.lr * (min(1, (step + 1) / plan.warm) * (0.5 + 0.5 * math.cos(math.pi * step / plan.steps)) + 0.01)


def stream(seed, *names):
    """A random generator for these names, independent of all others."""
    return random.Random(hashlib.sha256("/".join(map(str, (seed, *names))).encode()).digest())


def digest(value):
    """SHA-256 in hexadecimal of tensors, arrays, numbers, strings, and lists and dictionaries of them."""
    h = hashlib.sha256()

    def add(v):
        if torch.is_tensor(v):
            v = v.detach().cpu().contiguous().numpy()
        if isinstance(v, np.ndarray):
            h.update(f"{v.dtype}{v.shape}".encode() + np.ascontiguousarray(v).tobytes())
        elif isinstance(v, dict):
            h.update(b"{")
            for k in v:
                h.update(repr(k).encode())
                add(v[k])
            h.update(b"}")
        elif isinstance(v, (list, tuple)):
            h.update(b"[")
            for w in v:
                add(w)
            h.update(b"]")
        else:
            h.update(repr(v).encode() + b",")

    add(value)
    return h.hexdigest()


def generators():
    """States of all random generators that a step may use."""
    cards = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {"torch": torch.get_rng_state(), "cards": cards, "numpy": np.random.get_state(), "python": random.getstate()}


def restore(states):
    torch.set_rng_state(states["torch"])
    if len(states["cards"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(states["cards"])
    np.random.set_state(states["numpy"])
    random.setstate(states["python"])


def seed_all(seed):
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


class Learner:
    """A network, its optimiser, and the moving average of its weights, in `mean` if given.

    The pretrained parameters `slow` learn at `gain` times the rate and without weight decay. A step does not wait for the device."""

    def __init__(self, net, plan, mean=None, slow=(), gain=1.0):
        self.net, self.plan = net, plan
        self.mean = (copy.deepcopy(net) if mean is None else mean).eval().requires_grad_(False)
        self.params = [p for p in net.parameters() if p.requires_grad]
        groups, known = [], {id(p) for p in slow}
        for params, options in (([p for p in self.params if id(p) not in known], {}), (list(slow), {"gain": gain, "weight_decay": 0.0})):
            groups += [{"params": params, **options}] if params else []
        self.optimiser = torch.optim.AdamW(groups, plan.lr, weight_decay=plan.weight_decay, fused=True)
        pairs = list(zip(self.mean.state_dict().values(), net.state_dict().values(), strict=True))
        self.blended = [[p[i] for p in pairs if p[1].is_floating_point()] for i in (0, 1)]
        self.copied = [p for p in pairs if not p[1].is_floating_point()]

    def learn(self, loss, step):
        """Does one optimiser step. Returns 1.0, on the device, if the gradient is not finite and the step is skipped, else 0.0."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate(self.plan, step) * group.get("gain", 1.0)
        self.optimiser.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.params, 1.0)
        # the fused optimiser skips the step by this value, as with a gradient scaler
        self.optimiser.grad_scale, self.optimiser.found_inf = None, (~norm.isfinite()).float()
        self.optimiser.step()
        self.blend(step + 1)
        return self.optimiser.found_inf

    @torch.no_grad()
    def blend(self, step):
        """Updates the moving average of weights and buffers; early steps count more."""
        share = 1 - min(self.plan.ema, (1 + step) / (10 + step))
        torch._foreach_lerp_(*self.blended, share)
        for kept, live in self.copied:
            kept.copy_(live)


def reached(out):
    """Number of steps of the run in a folder."""
    last = Path(out) / "last.pt"
    return torch.load(last, weights_only=False, map_location="cpu")["step"] if last.exists() else 0


def save(path, state):
    part = Path(f"{path}.part")
    torch.save(state, part)
    part.replace(path)


def train(out, plan, net, loss_at, inputs, options=None, measure=None, stop=None, minutes=None, mean=None, quiet=False, slow=(), gain=1.0):
    """Trains `net`, resumes from `out`/last.pt if it exists, and returns the final state.

    `loss_at(step)` returns a dictionary of scalar tensors and minimises its `loss`. `measure(mean)` returns figures of the averaged weights; the smallest
    `score`, if any, becomes best.pt. `inputs` are lists of input files by name. `options` are other parameters that affect the run. `stop` ends it after
    that many steps, `minutes` after that time; it can resume later. `mean`, `slow` and `gain` are as in [`Learner`]. A step with a gradient that is not
    finite is skipped (`left out` in the log). Also writes weights.pt and last_weights.pt: the averaged weights of best.pt and last.pt in float16, as in the
    exported file. Raises [`Changed`].
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(plan.threads)
    # GPUs lack deterministic versions of some operations
    torch.use_deterministic_algorithms(next(net.parameters()).device.type == "cpu")
    # benchmarking would repeat for every shape
    torch.backends.cudnn.benchmark = False
    wanted = {"plan": asdict(plan), "options": options or {}}
    learner = Learner(net, plan, mean, slow, gain)
    step, best, rows, seen = 0, math.inf, [], {}
    if (out / "last.pt").exists():
        s = torch.load(out / "last.pt", weights_only=False, map_location="cpu")
        if s["wanted"] != wanted:
            raise Changed(f"{out}: started with {s['wanted']}, not with {wanted}; choose another folder with --out")
        for name, part in (("live", net), ("mean", learner.mean), ("optimiser", learner.optimiser)):
            part.load_state_dict(s[name])
        step, best, rows, seen = s["step"], s["best"], s["rows"], s["seen"]
    else:
        s = None
        seed_all(plan.seed)
    run_record.begin(out, step, inputs, wanted)
    # last, so that nothing above uses the restored generators
    if s is not None:
        restore(s["generators"])
    end, progress = min(plan.steps, stop or plan.steps), Progress(step, quiet)
    while step < end:
        net.train()
        parts = loss_at(step)
        left_out = learner.learn(parts["loss"], step)
        step += 1
        # keep figures on the device until they are printed, because a transfer waits for the device
        for k, v in (parts | {"left out": left_out}).items():
            seen.setdefault(k, []).append(v.detach())
        if minutes and progress.seconds() > 60 * minutes:
            end = step
        whole = step % plan.every == 0 or step == plan.steps
        if whole:
            row = {"step": step, **{k: average(v) for k, v in seen.items()}, **(measure(learner.mean) if measure else {})}
            rows, seen = [*rows, row], {}
            if row.get("score", math.inf) < best:
                best = row["score"]
                save(out / "best.pt", {"mean": learner.mean.state_dict(), "step": step, "row": row})
                save(out / "weights.pt", compact_weights(learner.mean, step, row))
            progress.row(row)
        elif step % PRINT_EVERY == 0:
            progress.row({"step": step, "loss": average(seen["loss"][-PRINT_EVERY:])})
        if whole or step == end:
            state = {
                "wanted": wanted, "live": net.state_dict(), "mean": learner.mean.state_dict(), "optimiser": learner.optimiser.state_dict(),
                "step": step, "best": best, "rows": rows, "seen": {k: numbers(v) for k, v in seen.items()}, "generators": generators(),
            }  # fmt: skip
            save(out / "last.pt", state)
            save(out / "last_weights.pt", compact_weights(learner.mean, step, rows[-1] if rows else {}))
            write_log(out / "log.csv", rows)
            run_record.finished(out, step, digest(state))
    return torch.load(out / "last.pt", weights_only=False, map_location="cpu")


class Progress:
    """Prints progress and speed of a run."""

    def __init__(self, step, quiet):
        self.start = self.since = time.time()
        self.step, self.quiet = step, quiet

    def seconds(self):
        return time.time() - self.start

    def row(self, row):
        if self.quiet:
            return
        now = time.time()
        speed, self.since, self.step = (row["step"] - self.step) / max(now - self.since, 1e-9), now, row["step"]
        figures = " ".join(f"{k} {v:.4f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
        print(f"[{now - self.start:6.0f} s] {figures}, {speed:.2f} steps/s", flush=True)


def compact_weights(mean, step, row):
    """The averaged weights for copying: on the CPU, large ones in float16."""
    small = lambda v: v.half() if v.dtype == torch.float32 and v.numel() >= 512 else v
    return {"mean": {k: small(v).cpu().clone() for k, v in mean.state_dict().items()}, "step": step, "row": row}


def numbers(values):
    """Converts scalar tensors among the values to numbers, in one transfer."""
    tensors = [v for v in values if torch.is_tensor(v)]
    converted = iter(torch.stack(tensors).double().tolist() if tensors else [])
    return [next(converted) if torch.is_tensor(v) else v for v in values]


def average(values):
    """Mean of the finite numbers and scalar tensors."""
    values = np.array(numbers(values))
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else math.nan


def write_log(path, rows):
    """Writes all rows so far; a step that ran twice, before and after a stop, appears once."""
    columns = list(dict.fromkeys(k for r in rows for k in r))
    with open(path, "w", newline="") as f:
        w = csv.DictWriter(f, columns)
        w.writeheader()
        w.writerows(rows)


def arguments(parser, steps, seed, every):
    """Adds the common options of all trainings."""
    parser.add_argument("--steps", type=int, default=steps, help="length of the whole run, over which the learning rate falls")
    parser.add_argument("--stop", type=int, help="stop after that many steps; the same command without it resumes")
    parser.add_argument("--minutes", type=float, help="stop after this time, plus the time of the last checkpoint")
    parser.add_argument("--every", type=int, default=every, help="steps between checkpoints")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=seed)


def remaining(args, *but):
    """Options for `train` that affect the run and are not in its plan."""
    return {k: v for k, v in sorted(vars(args).items()) if k not in {"steps", "stop", "minutes", "every", "threads", "seed", "out", *but}}
