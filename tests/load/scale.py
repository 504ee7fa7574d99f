#!/usr/bin/env python3
"""Several nodes on one S3 store lose and double nothing under `kill -9` of each kind of node, full disks, clocks that jump, cuts of the network, and
while the store is away.

`--gone` instead serves photos on while the store is gone. Cuts and small disks are for root alone, clocks need libfaketime."""
import argparse, os, queue, random, re, shutil, subprocess, tempfile, threading, time, urllib.parse, urllib.request
from pathlib import Path
from common import Server, Table, check, end, ramp, small
from engines import Clock, Network, Place, Proxy, s3_server

LEASE = 5


class Nodes:
    """Two nodes that serve and two that make photos, on one S3 store: behind a proxy, or each in a place of its own that can be cut off."""

    def __init__(self, apart=False, clock=False):
        self.folder, self.small = Path(tempfile.mkdtemp(prefix="tmpi-scale-")), None
        self.network = Network() if apart else None
        places = [self.network.place() for _ in range(6)] if apart else [Place()] * 6
        self.clock = Clock(self.folder) if clock else None
        self.s3 = s3_server(places[3])
        self.proxy = None if apart else Proxy(self.s3.port)
        store = (self.s3.place.host, self.s3.port) if apart else ("127.0.0.1", self.proxy.port)
        env = {"AWS_ENDPOINT_URL": f"http://{store[0]}:{store[1]}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_REGION": "us-east-1"}
        jumping = {**env, **(self.clock.env if clock else {})}
        common = ("--store", "s3://photos/tmpi", "--queue", "10000", "--lease", str(LEASE))
        self.serve = [Server(*common, "--role", "serve", env=e) for e in (env, jumping)]
        workers = zip(places[4:], (env, jumping))
        self.work = [Server(*common, "--access", "open", "--role", "work", env=e, prefix=p.prefix, host=p.host) for p, e in workers]

    def done(self):
        # no node knows all photos
        return sum(name.startswith("tmpi/ends/") for name in listing(self.s3))

    def small_disk(self, node, inodes):
        """Has one of `node` on a small disk of its own, which is full of bytes or of files."""
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
        if self.small:
            subprocess.run(["umount", self.small], capture_output=True)
        if self.network:
            self.network.remove()
        shutil.rmtree(self.folder, ignore_errors=True)


def restart(server):
    server.kill()
    server.start()


def done(nodes):
    """Photos that are made; a network that was cut takes a moment to come back."""
    until = time.monotonic() + 120
    while True:
        try:
            return nodes.done()
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.1)


def round_of(table, name, uploads, harm, seed, before=lambda nodes: None, **kind):
    """`uploads` photos while `harm` is done again and again; what became of each."""
    nodes = Nodes(**kind)
    before(nodes)
    photos, accepted, refused, depth, stop, recoveries = queue.Queue(), {}, {}, ramp(), threading.Event(), []
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

    def trouble():
        while not stop.is_set():
            harm(nodes)
            # until the next photo is made, where one waits
            began = time.monotonic()
            then = done(nodes)
            while done(nodes) <= then < len(accepted) and time.monotonic() - began < 120:
                time.sleep(0.1)
            recoveries.append(time.monotonic() - began)
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
    states = [nodes.serve[0].wait(photo, 600)["state"] for photo in accepted.values()]
    lost = sum(state.startswith("answer") for state in states)
    finished = states.count("done")
    # of one making one result is kept: the names of all ends and atlases, as the store has them
    names = listing(nodes.s3)
    ends = [n for n in names if n.startswith("tmpi/ends/")]
    atlases = [n for n in names if n.endswith(".atlas.tmpi")]
    double = len(ends) - len(set(accepted.values()))
    check(len(accepted) == uploads and lost == 0 and finished == uploads and double == 0, f"{name}: {len(accepted)} accepted, {finished} finished, {lost} lost, {double} double")
    worst = max(recoveries)
    check(worst <= 30, f"{name}: {worst:.1f} s until photos are made again")
    told = ", ".join(f"{n} × {s}" for s, n in sorted(refused.items())) or "none"
    table.row(name, len(recoveries), len(accepted), finished, lost, double, len(atlases) - len(ends), f"{worst:.1f} s", f"{time.monotonic() - began:.0f} s", told)
    nodes.remove()


def listing(s3):
    names, token = [], ""
    while True:
        query = f"list-type=2&prefix=tmpi/{'&continuation-token=' + urllib.parse.quote(token) if token else ''}"
        text = urllib.request.urlopen(f"http://{s3.place.host}:{s3.port}/photos?{query}", timeout=30).read().decode()
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
    return harm


def cut(which, seconds):
    """Cuts places off, longer than a lease."""
    def harm(nodes):
        places = which(nodes)
        nodes.network.set(places, True)
        time.sleep(seconds)
        nodes.network.set(places, False)
    return harm


def jump(rng):
    def harm(nodes):
        nodes.clock.set(rng.choice([-86400, -3600, 3600, 86400, 10 * 365 * 86400]))
        time.sleep(3)
    return harm


def read_on(photo, k):
    """What is asked of a node for the `k`th time."""
    at = f"/v1/photos/{photo}"
    return "/healthz", at, f"{at}/atlas", f"{at}/thumbnail", f"{at}/view?w=64&tx={k % 50 / 1000}"


def gone(table, seconds):
    """The store is gone: nodes are alive, and what was read before is read on."""
    nodes = Nodes()
    ids = []
    for n in range(8):
        status, answer = nodes.serve[n % 2].upload(small(n, 96, 72), ramp())
        check(status in (201, 202), f"an upload: {status}")
        ids.append(answer["id"])
    for node in nodes.serve:
        for photo in ids:
            check(node.wait(photo, 120)["state"] == "done", "photos are made")
            for path in read_on(photo, 0):
                check((status := node.get(path)[0]) == 200, f"{path} is read: {status}")
    nodes.proxy.set(True)
    asked, wrong, worst, began, k = 0, {}, 0.0, time.monotonic(), 0
    while time.monotonic() - began < seconds:
        photo, k = ids[k % len(ids)], k + 1
        for node in nodes.serve:
            for path in read_on(photo, k):
                then = time.monotonic()
                status = node.get(path, timeout=30)[0]
                worst, asked = max(worst, time.monotonic() - then), asked + 1
                if status != 200:
                    key = (path.rsplit("/", 1)[-1].split("?")[0] if path.count("/") > 2 else path, status)
                    wrong[key] = wrong.get(key, 0) + 1
        for node in nodes.work:
            status, asked = node.get("/healthz", timeout=30)[0], asked + 1
            if status != 200:
                wrong["worker", status] = wrong.get(("worker", status), 0) + 1
        time.sleep(0.2)
    refused = nodes.serve[0].upload(small(1000, 96, 72), ramp())[0]
    nodes.proxy.set(False)
    back = time.monotonic()
    while (answer := nodes.serve[0].upload(small(1001, 96, 72), ramp()))[0] not in (201, 202) and time.monotonic() - back < 60:
        time.sleep(0.1)
    made = check(answer[0] in (201, 202), "uploads are taken again") and nodes.serve[1].wait(answer[1]["id"], 60)["state"]
    check(not wrong and refused == 503 and made == "done", f"gone: {wrong}, an upload {refused}, then {made}")
    table.row(f"{seconds} s", asked, sum(wrong.values()), f"{worst * 1000:.0f} ms", refused, f"{time.monotonic() - back:.1f} s")
    nodes.remove()


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    args.add_argument("--gone", action="store_true", help="store gone, for 10 minutes with --full")
    args.add_argument("--uploads", type=int, help="photos of a round")
    args.add_argument("--only", default="", help="rounds with this in their name")
    args = args.parse_args()
    if args.gone:
        gone(Table("gone for", "requests", "not 200", "slowest", "an upload meanwhile", "made again after"), 600 if args.full else 20)
        end()
    uploads, rng, root = args.uploads or (500 if args.full else 16), random.Random(1), os.geteuid() == 0
    seconds = 60 if args.full else 5
    table = Table("under", "times", "accepted", "finished", "lost", "double", "thrown away", "until the next is made", "took", "tried again")
    rounds = [
        ("nothing", lambda nodes: None, {}),
        ("kill -9 of a node that serves", lambda nodes: restart(rng.choice(nodes.serve)), {}),
        ("kill -9 of a node that makes", lambda nodes: restart(rng.choice(nodes.work)), {}),
        (f"store away for {seconds} s", away_for(seconds), {}),
    ]
    if Clock.LIBRARY:
        rounds.append(("clocks of two nodes that jump", jump(rng), {"clock": True}))
    if root:
        apart = {"apart": True}
        rounds += [
            ("a worker cut off", cut(lambda nodes: [rng.choice(nodes.network.places[4:])], 2 * LEASE), apart),
            ("the store cut off", cut(lambda nodes: [nodes.network.places[3]], 2 * LEASE), apart),
        ]
        full = lambda part, inodes: lambda nodes: nodes.small_disk(getattr(nodes, part), inodes)
        rounds += [
                ("full disk of a worker", lambda nodes: None, {"before": full("work", False)}),
                ("no inodes left at a worker", lambda nodes: None, {"before": full("work", True)}),
                ("full disk of a node that serves", lambda nodes: None, {"before": full("serve", False)}),
                ("no inodes left at a node that serves", lambda nodes: None, {"before": full("serve", True)}),
        ]
    for n, (name, harm, kind) in enumerate(rounds):
        if args.only in name:
            round_of(table, name, uploads, harm, 1000 * n, **kind)
    end()


main()
