"""Renders scenes with `tmpi-lab synth` processes while the training learns from them."""

import itertools
import os
import queue
import shutil
import subprocess
import threading
from pathlib import Path

import cv2
import numpy as np

import pack
import sources

# scenes per chunk: a small first chunk, so that the training starts soon, then larger ones
FIRST_CHUNK, CHUNK = 8, 40
# smallest seed: seeds from 9 000 000 on are held out, smaller ones were rendered by hand
FIRST = 10**9


def read(item):
    """Reads a scene as a packed picture."""
    s = sources.read_item(item)
    return pack.Packed(item.name, item.group, item.space, False, s.rgb, s.value, s.region, np.zeros(1, np.uint8))


class Renderers:
    """Runs `count` processes, each with a thread that waits for it, with seeds from `first` on. Every second chunk uses models, if given."""

    def __init__(self, program, count, folder, first, pictures, models=None):
        self.program, self.folder, self.pictures, self.models = program, Path(folder), pictures, models
        self.found, self.ended, self.running = queue.Queue(), threading.Event(), {}
        self.seeds = itertools.count(first, CHUNK)
        self.lock = threading.Lock()
        self.threads = [threading.Thread(target=self.work, args=(worker,), daemon=True) for worker in range(count)]
        for thread in self.threads:
            thread.start()

    def work(self, worker):
        count = FIRST_CHUNK
        try:
            while not self.ended.is_set():
                with self.lock:
                    seed = next(self.seeds)
                self.found.put(self.chunk(worker, seed, count))
                count = CHUNK
        except Exception as e:  # `taken` raises it
            if not self.ended.is_set():
                self.found.put(e)

    def chunk(self, worker, seed, count):
        """Renders `count` scenes, starting with a seed."""
        out = self.folder / str(seed)
        models = ["--models", self.models, "--models-up", "z"] if self.models and (seed // CHUNK) % 2 else []
        command = [self.program, "synth", "-o", out, "--count", count, "--seed", seed, "--supersampling", 2, "--pictures", self.pictures, *models]
        environment = os.environ | {"RAYON_NUM_THREADS": "1"}
        self.running[worker] = subprocess.Popen(["nice", *map(str, command)], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        _, stderr = self.running[worker].communicate()
        if self.running[worker].returncode:
            raise RuntimeError(f"{self.program} synth: {stderr.decode()[-500:]}")
        scenes = [read(i) for i in sources.scenes([out])]
        shutil.rmtree(out)
        return scenes

    def taken(self, wait=False):
        """Returns new scenes; with `wait`, at least one chunk."""
        scenes = []
        while wait or not self.found.empty():
            chunk, wait = self.found.get(), False
            if isinstance(chunk, Exception):
                raise chunk
            scenes += chunk
        return scenes

    def close(self):
        self.ended.set()
        for process in list(self.running.values()):
            process.terminate()
        for thread in self.threads:
            thread.join()
        shutil.rmtree(self.folder, ignore_errors=True)


def textures(pictures, folder):
    """Writes the photographs of a pack as textures for `tmpi-lab synth`."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for n, p in enumerate(p for p in pictures if p.group in ("label", "photo") and not p.name.endswith(".b")):
        cv2.imwrite(str(folder / f"{n:04}.jpg"), cv2.cvtColor(p.rgb, cv2.COLOR_RGB2BGR))
    return folder
