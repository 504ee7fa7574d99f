"""The training loop of all three networks: counted in steps alone, and resumed to the same bits.

The learning rate, the shape of a batch and what is in it are functions of the seed and the step. What else is random (dropout, mixed
statistics) comes from the generators of PyTorch, NumPy and Python, which are seeded at the start and stored with every checkpoint: a run that was
stopped and went on ends with the same weights, bit for bit, as one that was not, on the same machine with as many threads.
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

import manifest


# steps between lines that tell the loss and the speed
SAID = 50


@dataclass(frozen=True)
class Plan:
    """What a run is, apart from its network and its data: a run with another plan is another run."""

    steps: int
    lr: float  # highest learning rate
    weight_decay: float
    ema: float  # decay of the running mean over weights
    every: int  # steps between rows of the log, measurements and checkpoints
    seed: int
    threads: int = 1
    warm: int = 50  # steps in which the learning rate rises to its highest


class Changed(SystemExit):
    """A run cannot go on: its plan, its options or its input files are not those that it began with."""


def rate(plan, step):
    """Learning rate of a step: a rise, then half a cosine down to a hundredth."""
    return plan.lr * (min(1, (step + 1) / plan.warm) * (0.5 + 0.5 * math.cos(math.pi * step / plan.steps)) + 0.01)


def stream(seed, *names):
    """A generator of its own for what the names say, whatever was drawn before from any other."""
    return random.Random(hashlib.sha256("/".join(map(str, (seed, *names))).encode()).digest())


def digest(value):
    """SHA-256 of tensors, arrays, numbers, texts and of lists and dictionaries of them, in hexadecimal."""
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
    """States of all generators that a step may draw from."""
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
    """A network, its optimiser, and the running mean of its weights, which is kept in `mean` where the caller has such a module.

    The parameters `slow` learn at the share `gain` of the rate and are not drawn to 0: they were trained elsewhere. A step waits for nothing that the
    device has under way."""

    def __init__(self, net, plan, mean=None, slow=(), gain=1.0):
        self.net, self.plan = net, plan
        self.mean = (copy.deepcopy(net) if mean is None else mean).eval().requires_grad_(False)
        self.params = [p for p in net.parameters() if p.requires_grad]
        groups, known = [], {id(p) for p in slow}
        for own, of in (([p for p in self.params if id(p) not in known], {}), (list(slow), {"gain": gain, "weight_decay": 0.0})):
            groups += [{"params": own, **of}] if own else []
        self.optimiser = torch.optim.AdamW(groups, plan.lr, weight_decay=plan.weight_decay, fused=True)
        pairs = list(zip(self.mean.state_dict().values(), net.state_dict().values(), strict=True))
        self.blended = [[p[i] for p in pairs if p[1].is_floating_point()] for i in (0, 1)]
        self.copied = [p for p in pairs if not p[1].is_floating_point()]

    def learn(self, loss, step):
        """One step down. Returns 1.0, on the device, where the gradient was not finite and the step left out, else 0.0."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate(self.plan, step) * group.get("gain", 1.0)
        self.optimiser.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.params, 1.0)
        # the optimiser itself looks at this, as it does where gradients are scaled
        self.optimiser.grad_scale, self.optimiser.found_inf = None, (~norm.isfinite()).float()
        self.optimiser.step()
        self.blend(step + 1)
        return self.optimiser.found_inf

    @torch.no_grad()
    def blend(self, step):
        """Moves the running mean of all weights and buffers; early steps count for more."""
        share = 1 - min(self.plan.ema, (1 + step) / (10 + step))
        torch._foreach_lerp_(*self.blended, share)
        for kept, live in self.copied:
            kept.copy_(live)


def reached(out):
    """Steps that the run in a folder has come to."""
    last = Path(out) / "last.pt"
    return torch.load(last, weights_only=False, map_location="cpu")["step"] if last.exists() else 0


def save(path, state):
    part = Path(f"{path}.part")
    torch.save(state, part)
    part.replace(path)


def train(out, plan, net, loss_at, inputs, options=None, measure=None, stop=None, minutes=None, mean=None, quiet=False, slow=(), gain=1.0):
    """Trains `net`, goes on from `out`/last.pt where that is there, and returns the state at the end.

    `loss_at(step)` gives a dictionary of scalar tensors of which `loss` is descended; `measure(mean)` gives figures of the running mean of the
    weights, of which the smallest `score`, if there is one, makes best.pt. `inputs` is what the run reads, by name: lists of files. `options` are
    whatever else decides what the run does. `stop` ends it early, after that many steps, and `minutes` after so long, to go on later. `mean`, `slow` and
    `gain` as in [`Learner`]. A step whose gradient is not finite is left out (`left out` in the log). Beside the checkpoints lie weights.pt and
    last_weights.pt: the mean of best.pt and of last.pt with float16 as in the exported file. Raises [`Changed`].
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(plan.threads)
    # a card has no such algorithms for all that is needed here
    torch.use_deterministic_algorithms(next(net.parameters()).device.type == "cpu")
    # it would try all algorithms anew for every shape
    torch.backends.cudnn.benchmark = False
    wanted = {"plan": asdict(plan), "options": options or {}}
    learner = Learner(net, plan, mean, slow, gain)
    step, best, rows, seen = 0, math.inf, [], {}
    if (out / "last.pt").exists():
        s = torch.load(out / "last.pt", weights_only=False, map_location="cpu")
        if s["wanted"] != wanted:
            raise Changed(f"{out}: begun with {s['wanted']}, not with {wanted}; name another folder with --out")
        for name, part in (("live", net), ("mean", learner.mean), ("optimiser", learner.optimiser)):
            part.load_state_dict(s[name])
        step, best, rows, seen = s["step"], s["best"], s["rows"], s["seen"]
    else:
        s = None
        seed_all(plan.seed)
    manifest.begin(out, step, inputs, wanted)
    # last of all, so that nothing above has drawn from them
    if s is not None:
        restore(s["generators"])
    end, told = min(plan.steps, stop or plan.steps), Told(step, quiet)
    while step < end:
        net.train()
        parts = loss_at(step)
        left_out = learner.learn(parts["loss"], step)
        step += 1
        # figures stay on the device until they are told: fetching one waits for all that it has under way
        for k, v in (parts | {"left out": left_out}).items():
            seen.setdefault(k, []).append(v.detach())
        if minutes and told.seconds() > 60 * minutes:
            end = step
        whole = step % plan.every == 0 or step == plan.steps
        if whole:
            row = {"step": step, **{k: average(v) for k, v in seen.items()}, **(measure(learner.mean) if measure else {})}
            rows, seen = [*rows, row], {}
            if row.get("score", math.inf) < best:
                best = row["score"]
                save(out / "best.pt", {"mean": learner.mean.state_dict(), "step": step, "row": row})
                save(out / "weights.pt", light(learner.mean, step, row))
            told.row(row)
        elif step % SAID == 0:
            told.row({"step": step, "loss": average(seen["loss"][-SAID:])})
        if whole or step == end:
            state = {
                "wanted": wanted, "live": net.state_dict(), "mean": learner.mean.state_dict(), "optimiser": learner.optimiser.state_dict(),
                "step": step, "best": best, "rows": rows, "seen": {k: numbers(v) for k, v in seen.items()}, "generators": generators(),
            }  # fmt: skip
            save(out / "last.pt", state)
            save(out / "last_weights.pt", light(learner.mean, step, rows[-1] if rows else {}))
            write_log(out / "log.csv", rows)
            manifest.finished(out, step, digest(state))
    return torch.load(out / "last.pt", weights_only=False, map_location="cpu")


class Told:
    """What is said of a run meanwhile, with its speed."""

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


def light(mean, step, row):
    """The running mean to carry elsewhere: large weights in float16, on the processor."""
    small = lambda v: v.half() if v.dtype == torch.float32 and v.numel() >= 512 else v
    return {"mean": {k: small(v).cpu().clone() for k, v in mean.state_dict().items()}, "step": step, "row": row}


def numbers(values):
    """Numbers, and tensors of one number, as numbers; those of a device come by one transfer."""
    there = [v for v in values if torch.is_tensor(v)]
    told = iter(torch.stack(there).double().tolist() if there else [])
    return [next(told) if torch.is_tensor(v) else v for v in values]


def average(values):
    """Mean of numbers and of tensors of one number, of those that are finite."""
    values = np.array(numbers(values))
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else math.nan


def write_log(path, rows):
    """All rows so far: a step that was run twice, before and after a stop, stands there once."""
    columns = list(dict.fromkeys(k for r in rows for k in r))
    with open(path, "w", newline="") as f:
        w = csv.DictWriter(f, columns)
        w.writeheader()
        w.writerows(rows)


def arguments(parser, steps, seed, every):
    """The options that every training has."""
    parser.add_argument("--steps", type=int, default=steps, help="length of the whole run: the learning rate falls over it")
    parser.add_argument("--stop", type=int, help="end after that many steps; the same command without it goes on")
    parser.add_argument("--minutes", type=float, help="end after so long, but for the last checkpoint")
    parser.add_argument("--every", type=int, default=every, help="steps between checkpoints")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=seed)


def remaining(args, *but):
    """Options that decide what a run does and are not in its plan, for `train`."""
    return {k: v for k, v in sorted(vars(args).items()) if k not in {"steps", "stop", "minutes", "every", "threads", "seed", "out", *but}}
