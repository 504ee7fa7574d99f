"""Processes of `tmpi-lab synth` that render scenes without end while a training learns from them."""

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

# scenes that a process renders before they are learnt from: at first, so that the training begins soon, and after that
SOON, CHUNK = 8, 40
# seeds are at least this: those from 9 000 000 on are held out, and those below were rendered by hand
FIRST = 10**9


def read(item):
    """A scene as a picture of the pack."""
    s = sources.read_item(item)
    return pack.Packed(item.name, item.group, item.space, False, s.rgb, s.value, s.region, np.zeros(1, np.uint8))


class Renderers:
    """`count` processes, each in a thread that waits for it, with seeds from `first` on. Every other chunk has models, where there are any."""

    def __init__(self, program, count, folder, first, pictures, models=None):
        self.program, self.folder, self.pictures, self.models = program, Path(folder), pictures, models
        self.found, self.ended, self.running = queue.Queue(), threading.Event(), {}
        self.seeds = itertools.count(first, CHUNK)
        self.lock = threading.Lock()
        self.threads = [threading.Thread(target=self.work, args=(worker,), daemon=True) for worker in range(count)]
        for thread in self.threads:
            thread.start()

    def work(self, worker):
        count = SOON
        try:
            while not self.ended.is_set():
                with self.lock:
                    seed = next(self.seeds)
                self.found.put(self.chunk(worker, seed, count))
                count = CHUNK
        except Exception as e:  # to be raised where scenes are taken
            if not self.ended.is_set():
                self.found.put(e)

    def chunk(self, worker, seed, count):
        """`count` scenes from a seed on."""
        out = self.folder / str(seed)
        models = ["--models", self.models, "--models-up", "z"] if self.models and (seed // CHUNK) % 2 else []
        command = [self.program, "synth", "-o", out, "--count", count, "--seed", seed, "--supersampling", 2, "--pictures", self.pictures, *models]
        environment = os.environ | {"RAYON_NUM_THREADS": "1"}
        self.running[worker] = subprocess.Popen(["nice", *map(str, command)], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        _, told = self.running[worker].communicate()
        if self.running[worker].returncode:
            raise RuntimeError(f"{self.program} synth: {told.decode()[-500:]}")
        scenes = [read(i) for i in sources.scenes([out])]
        shutil.rmtree(out)
        return scenes

    def taken(self, wait=False):
        """What was rendered since; with `wait` at least one chunk."""
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
    """Writes the photographs of a pack, from which `tmpi-lab synth` may cut its textures."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for n, p in enumerate(p for p in pictures if p.group in ("label", "photo") and not p.name.endswith(".b")):
        cv2.imwrite(str(folder / f"{n:04}.jpg"), cv2.cvtColor(p.rgb, cv2.COLOR_RGB2BGR))
    return folder
