#!/usr/bin/env python3
"""Several nodes on one store lose and double nothing under `kill -9` of each kind of node and while the store is away."""
import argparse, json, os, queue, random, shutil, socket, socketserver, subprocess, sys, tempfile, threading, time
from pathlib import Path
from common import Server, Table, check, end, ramp, small


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def listening(port):
    until = time.monotonic() + 30
    while time.monotonic() < until:
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            time.sleep(0.02)
    raise SystemExit(f"nothing listens on {port}")


class Engine:
    """A process on a port of its own."""

    def __init__(self, command, port):
        self.command, self.port = command, port
        self.start()

    def start(self):
        self.process = subprocess.Popen(self.command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        listening(self.port)

    def kill(self):
        self.process.kill()
        self.process.wait()


class Proxy:
    """Passes connections on, and answers 503 while `away`."""

    def __init__(self, port):
        proxy, self.away, self.open = self, False, set()

        class Handler(socketserver.BaseRequestHandler):
            def handle(self):
                if proxy.away:
                    self.request.recv(65536)
                    self.request.sendall(b"HTTP/1.1 503 Slow Down\r\ncontent-length: 0\r\nconnection: close\r\n\r\n")
                    return
                there = socket.create_connection(("127.0.0.1", port))
                pair = (self.request, there)
                proxy.open.add(pair)
                back = threading.Thread(target=copy, args=(there, self.request), daemon=True)
                back.start()
                copy(self.request, there)
                back.join()
                proxy.open.discard(pair)
                there.close()

        class Listener(socketserver.ThreadingTCPServer):
            daemon_threads, allow_reuse_address, request_queue_size = True, True, 128

        self.server = Listener(("127.0.0.1", 0), Handler)
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def set(self, away):
        self.away = away
        for pair in list(self.open) if away else []:
            for s in pair:
                shut(s)


def shut(s):
    try:
        s.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass


def copy(source, target):
    try:
        while data := source.recv(65536):
            target.sendall(data)
    except OSError:
        pass
    shut(target)


class Nodes:
    """Two nodes that serve and two that make photos, on one S3 store behind a proxy."""

    def __init__(self):
        self.folder, self.small = Path(tempfile.mkdtemp(prefix="tmpi-scale-")), None
        port = free_port()
        self.s3 = Engine([sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], port)
        self.proxy = Proxy(port)
        import urllib.request
        urllib.request.urlopen(urllib.request.Request(f"http://127.0.0.1:{port}/photos", method="PUT"), timeout=10)
        env = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.proxy.port}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_REGION": "us-east-1"}
        common = ("--store", "s3://photos/tmpi", "--queue", "10000", "--lease", "5")
        self.serve = [Server(*common, "--role", "serve", env=env) for _ in range(2)]
        self.work = [Server(*common, "--role", "work", env=env) for _ in range(2)]

    def fill_a_worker(self):
        """Has another worker on a small disk of its own, which is full; false where only root mounts one here."""
        self.small = self.folder / "small"
        self.small.mkdir()
        if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", self.small], capture_output=True).returncode:
            self.small = None
            return False
        common = self.work[0].args
        self.work[0].stop()
        self.work[0] = Server(*common, data=self.small, env=self.work[0].env)
        with open(self.small / "filler", "wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(1 << 12))
            except OSError:
                pass
        return True

    def remove(self):
        for server in self.serve + self.work:
            server.remove()
        self.s3.kill()
        if self.small:
            subprocess.run(["umount", self.small], capture_output=True)
        shutil.rmtree(self.folder, ignore_errors=True)


def restart(server):
    server.kill()
    server.start()


def round_of(table, name, uploads, harm, seed, before=lambda nodes: True):
    """`uploads` photos while `harm` is done again and again; what became of each."""
    nodes = Nodes()
    if not before(nodes):
        table.row(name, "skipped: only root mounts a small disk here", *[""] * 6)
        nodes.remove()
        return
    photos, accepted, depth, stop = queue.Queue(), {}, ramp(), threading.Event()
    for n in range(uploads):
        photos.put(n)

    def client(k):
        while True:
            try:
                n = photos.get_nowait()
            except queue.Empty:
                return
            while True:
                status, answer = nodes.serve[(n + k) % 2].upload(small(seed + n, 96, 72), depth, timeout=60)
                if status in (200, 201, 202):
                    accepted[n] = answer["id"]
                    break
                k += 1
                time.sleep(0.1)

    def trouble():
        while not stop.is_set():
            harm(nodes)
            stop.wait(1)

    began = time.monotonic()
    clients = [threading.Thread(target=client, args=(k,)) for k in range(4)]
    hurts = threading.Thread(target=trouble)
    for thread in [*clients, hurts]:
        thread.start()
    for thread in clients:
        thread.join()
    stop.set()
    hurts.join()
    recovered = time.monotonic()
    states = [nodes.serve[0].wait(photo, 300)["state"] for photo in accepted.values()]
    recovery = time.monotonic() - recovered
    lost = sum(state.startswith("answer") for state in states)
    finished = states.count("done")
    # of one making one result is kept: the names of all ends and atlases, as the store has them
    names = listing(nodes.s3.port)
    ends = [n for n in names if n.startswith("tmpi/ends/")]
    atlases = [n for n in names if n.endswith(".atlas.tmpi")]
    double = len(ends) - len(set(accepted.values()))
    check(len(accepted) == uploads and lost == 0 and finished == uploads and double == 0, f"{name}: {len(accepted)} accepted, {finished} finished, {lost} lost, {double} double")
    table.row(name, len(accepted), finished, lost, double, len(atlases) - len(ends), f"{recovery:.1f} s", f"{time.monotonic() - began:.0f} s")
    nodes.remove()


def listing(port):
    import re, urllib.parse, urllib.request
    names, token = [], ""
    while True:
        query = f"list-type=2&prefix=tmpi/{'&continuation-token=' + urllib.parse.quote(token) if token else ''}"
        text = urllib.request.urlopen(f"http://127.0.0.1:{port}/photos?{query}", timeout=30).read().decode()
        names += re.findall(r"<Key>([^<]*)</Key>", text)
        found = re.search(r"<NextContinuationToken>([^<]*)<", text)
        if not found:
            return names
        token = found[1]


def away_for(seconds):
    def harm(nodes):
        nodes.proxy.set(True)
        began, alive = time.monotonic(), True
        while time.monotonic() - began < seconds:
            alive &= all(node.get("/healthz", timeout=20)[0] == 200 for node in nodes.serve + nodes.work)
            time.sleep(0.5)
        nodes.proxy.set(False)
        check(alive, "every node is alive while the store is away")
        time.sleep(2)
    return harm


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    uploads, rng = 100 if full else 16, random.Random(1)
    table = Table("under", "accepted", "finished", "lost", "double", "thrown away", "recovery", "took")
    rounds = [
        ("nothing", lambda nodes: None),
        ("kill -9 of a node that serves", lambda nodes: restart(rng.choice(nodes.serve))),
        ("kill -9 of a node that makes", lambda nodes: restart(rng.choice(nodes.work))),
        (f"store away for {60 if full else 5} s", away_for(60 if full else 5)),
    ]
    for n, (name, harm) in enumerate(rounds):
        round_of(table, name, uploads, harm, 1000 * n)
    round_of(table, "full disk of a node that makes", uploads, lambda nodes: None, 1000 * len(rounds), Nodes.fill_a_worker)
    end()


main()
