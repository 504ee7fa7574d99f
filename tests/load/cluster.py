#!/usr/bin/env python3
"""Nodes that share a PostgreSQL database and an S3 store neither lose nor duplicate photos during `kill -9` of nodes and of PostgreSQL, an outage of the
store, full disks, clocks that jump, and network partitions. Partitions and full disks need root, clocks need libfaketime."""
import argparse, os, queue, random, shutil, subprocess, tempfile, threading, time
from pathlib import Path
from common import Server, Table, check, depth_map, finish, skip, small
from services import Clock, Location, Network, Postgres, Proxy, s3_server

# seconds
LEASE = 5


class Nodes:
    """Two nodes that serve and two that make photos, with one database and one S3 store: behind a proxy, or in network namespaces that can be disconnected."""

    def __init__(self, apart=False, clock=False):
        self.folder, self.small = Path(tempfile.mkdtemp(prefix="tmpi-scale-")), None
        self.network = Network() if apart else None
        locations = [self.network.add_location() for _ in range(3)] if apart else [Location()] * 3
        self.clock = Clock(self.folder) if clock else None
        self.database = Postgres(self.folder)
        self.s3 = s3_server(locations[0])
        self.proxy = None if apart else Proxy(self.s3.port)
        store = (self.s3.location.host, self.s3.port) if apart else ("127.0.0.1", self.proxy.port)
        env = {"AWS_ENDPOINT_URL": f"http://{store[0]}:{store[1]}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_REGION": "us-east-1", "AWS_ALLOW_HTTP": "true"}
        env_with_clock = {**env, **(self.clock.env if clock else {})}
        common = ("--database", self.database.url, "--blobs", "s3://photos/tmpi", "--set", "limits.queue=10000", "--set", f"limits.lease={LEASE}")
        self.serve = [Server(*common, "--role", "serve", env=e) for e in (env, env_with_clock)]
        workers = zip(locations[1:], (env, env_with_clock))
        self.work = [Server(*common, "--access", "open", "--role", "work", env=e, prefix=p.prefix, host=p.host) for p, e in workers]

    def done(self):
        return int(self.serve[0].metric("tmpi_photos_done"))

    def fill_disk(self, node, inodes):
        """Moves the first of `node` to a small disk without free bytes, or without free inodes."""
        self.small = self.folder / "small"
        self.small.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", "nr_inodes=200" if inodes else "size=20m", "tmpfs", self.small], check=True)
        before = node[0]
        before.stop()
        node[0] = Server(*before.args, data=self.small, env=before.env)
        (self.small / "filler").mkdir()
        try:
            for n in range(1 << 16):
                with open(self.small / "filler" / str(n if inodes else 0), "ab", buffering=0) as file:
                    file.write(b"" if inodes else bytes(1 << 12))
        except OSError:
            pass

    def remove(self):
        for server in self.serve + self.work:
            server.remove()
        self.s3.kill()
        self.database.kill()
        if self.small:
            subprocess.run(["umount", self.small], capture_output=True)
        if self.network:
            self.network.remove()
        shutil.rmtree(self.folder, ignore_errors=True)


def restart(server):
    server.kill()
    server.start()


def photos_made(nodes):
    """Number of photos made; retries because a reconnected network takes a moment to work."""
    deadline = time.monotonic() + 120
    while True:
        try:
            return nodes.done()
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def run_round(table, name, uploads, harm, seed, before=lambda nodes: None, **kind):
    """Uploads photos while `harm` runs repeatedly, and checks what becomes of each."""
    nodes = Nodes(**kind)
    before(nodes)
    photos, accepted, refused, depth, stop, recoveries = queue.Queue(), {}, {}, depth_map(), threading.Event(), []
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
                refused[status] = refused.get(status, 0) + 1
                k += 1
                time.sleep(0.1)

    def inject_faults():
        while not stop.is_set():
            harm(nodes)
            # recovery ends when the next waiting photo is made
            began = time.monotonic()
            made = photos_made(nodes)
            while photos_made(nodes) <= made < len(accepted) and time.monotonic() - began < 120:
                time.sleep(0.1)
            recoveries.append(time.monotonic() - began)
            stop.wait(1)

    began = time.monotonic()
    clients = [threading.Thread(target=client, args=(k,)) for k in range(4)]
    faults = threading.Thread(target=inject_faults)
    for thread in [*clients, faults]:
        thread.start()
    for thread in clients:
        thread.join()
    stop.set()
    faults.join()
    states = [nodes.serve[0].wait(photo, 600)["state"] for photo in accepted.values()]
    lost = sum(state.startswith("status") for state in states)
    finished = states.count("done")
    double = nodes.done() - len(set(accepted.values()))
    check(len(accepted) == uploads and lost == 0 and finished == uploads and double == 0, f"{name}: {len(accepted)} accepted, {finished} finished, {lost} lost, {double} duplicate")
    worst = max(recoveries)
    check(worst <= 30, f"{name}: {worst:.1f} s until the next photo is made")
    retried = ", ".join(f"{n} × {s}" for s, n in sorted(refused.items())) or "none"
    table.row(name, len(recoveries), len(accepted), finished, lost, double, f"{worst:.1f} s", f"{time.monotonic() - began:.0f} s", retried)
    nodes.remove()


def store_down_for(seconds):
    def harm(nodes):
        nodes.proxy.set_down(True)
        began, alive = time.monotonic(), True
        while time.monotonic() - began < seconds:
            alive &= all(node.get("/healthz", timeout=20)[0] == 200 for node in nodes.serve + nodes.work)
            time.sleep(0.5)
        nodes.proxy.set_down(False)
        check(alive, "every node stays healthy while the store is down")
    return harm


def partition(which, seconds):
    """Disconnects locations for longer than a lease."""
    def harm(nodes):
        locations = which(nodes)
        nodes.network.set_connected(locations, False)
        time.sleep(seconds)
        nodes.network.set_connected(locations, True)
    return harm


def clock_jump(rng):
    def harm(nodes):
        nodes.clock.set(rng.choice([-86400, -3600, 3600, 86400, 10 * 365 * 86400]))
        time.sleep(3)
    return harm


def restart_database(nodes):
    nodes.database.kill()
    time.sleep(2)
    nodes.database.start()


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    args.add_argument("--uploads", type=int, help="photos per round")
    args.add_argument("--only", default="", help="run only rounds with this in their name")
    args = args.parse_args()
    uploads, rng, root = args.uploads or (500 if args.full else 16), random.Random(1), os.geteuid() == 0
    seconds = 60 if args.full else 5
    table = Table("fault", "times", "accepted", "finished", "lost", "duplicate", "until the next is made", "took", "retried uploads")
    rounds = [
        ("no fault", lambda nodes: None, {}),
        ("kill -9 of a node that serves", lambda nodes: restart(rng.choice(nodes.serve)), {}),
        ("kill -9 of a node that makes photos", lambda nodes: restart(rng.choice(nodes.work)), {}),
        ("kill -9 of PostgreSQL", restart_database, {}),
        (f"store down for {seconds} s", store_down_for(seconds), {}),
    ]
    if Clock.LIBRARY:
        rounds.append(("clocks of two nodes jump", clock_jump(rng), {"clock": True}))
    else:
        skip("clocks that jump", "libfaketime is not installed")
    if not root:
        skip("partitions and full disks", "network namespaces and mounts need root")
    else:
        apart = {"apart": True}
        rounds += [
            ("a worker disconnected", partition(lambda nodes: [rng.choice(nodes.network.locations[1:])], 2 * LEASE), apart),
            ("the store disconnected", partition(lambda nodes: [nodes.network.locations[0]], 2 * LEASE), apart),
        ]
        full = lambda part, inodes: lambda nodes: nodes.fill_disk(getattr(nodes, part), inodes)
        rounds += [
            ("full disk on a node that serves", lambda nodes: None, {"before": full("serve", False)}),
            ("no inodes left on a node that serves", lambda nodes: None, {"before": full("serve", True)}),
        ]
    for n, (name, harm, kind) in enumerate(rounds):
        if args.only in name:
            run_round(table, name, uploads, harm, 1000 * n, **kind)
    finish()


main()
