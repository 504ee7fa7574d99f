#!/usr/bin/env python3
"""Cost of one photo and of one page view in processor time and store requests, measured with a node that serves and one that makes photos on one S3 store
(moto), and an estimate for a million photos and a hundred million page views a day. Other work on the machine matters little to processor time."""
import argparse, collections, os, re, subprocess, sys, tempfile, time
from pathlib import Path
import engines
from common import Server, Table, check, children, end, smooth

DAY = 86_400
PHOTOS, LOOKS = 1_000_000, 100_000_000
# the busiest hour of a day over its mean, as is usual of what people look at
PEAK = 3.0


def seconds(pid):
    fields = open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()
    # with that of children that have ended
    return sum(int(f) for f in fields[11:15]) / os.sysconf("SC_CLK_TCK")


def spent(server):
    return sum(seconds(pid) for pid in [server.process.pid, *children(server.process.pid)])


class Log:
    """Requests of the store by kind, from its log."""

    KINDS = {"PUT": "writes", "POST": "writes", "GET": "reads", "HEAD": "reads", "DELETE": "deletions"}

    def __init__(self, path):
        self.path = path

    def counts(self):
        found = collections.Counter()
        for method, target in re.findall(r'"(\w+) (\S+) HTTP', self.path.read_text()):
            found["lists" if method == "GET" and "list-type" in target else self.KINDS.get(method, method)] += 1
        return found


def store(folder):
    log = Log(folder / "store.log")
    began = engines.Engine.start

    def start(engine):
        engine.process = subprocess.Popen(engine.command, stdout=subprocess.DEVNULL, stderr=open(log.path, "a"), env=engine.env)
        engines.listening(engine.port, engine.place.host)

    engines.Engine.start = start
    engine = engines.s3_server()
    engines.Engine.start = began
    return engine, log


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--photos", metavar="FOLDER", help="photos to upload; without it pictures of 2 megapixels")
    args.add_argument("--count", type=int, default=16)
    args = args.parse_args()
    photos = [p.read_bytes() for p in sorted(Path(args.photos).glob("*.jp*g"))[: args.count]] if args.photos else [smooth(2, seed=n) for n in range(args.count)]
    with tempfile.TemporaryDirectory(prefix="tmpi-load-") as folder:
        engine, log = store(Path(folder))
        env = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{engine.port}", "AWS_ALLOW_HTTP": "true", "AWS_REGION": "us-east-1", "AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test"}
        database = engines.Postgres(Path(folder))
        at = ("--database", database.url, "--blobs", "s3://photos/tmpi", "--set", "limits.queue=1000")
        serve, work = Server(*at, "--role", "serve", env=env), Server(*at, "--role", "work", env=env)
        # the first photo loads networks and libraries
        status, first = serve.upload(smooth(0.1))
        check(status == 202 and serve.wait(first["id"])["state"] == "done", f"the first photo: {status} {first}")
        before, idle = log.counts(), 20
        time.sleep(idle)
        steady = {kind: (n - before[kind]) / idle for kind, n in log.counts().items()}
        before, cpu, start = log.counts(), (spent(serve), spent(work)), time.monotonic()
        ids = []
        for photo in photos:
            status, answer = serve.upload(photo)
            if check(status == 202, f"an upload: {status} {answer.get('detail')}"):
                ids.append(answer["id"])
        states = [serve.wait(i) for i in ids]
        check(all(s["state"] == "done" for s in states), "all are made")
        took, n = time.monotonic() - start, len(ids)
        asked = {kind: max(0.0, (count - before[kind] - steady.get(kind, 0) * took) / n) for kind, count in log.counts().items()}
        serve_s, work_s = ((spent(server) - was) / n for server, was in zip((serve, work), cpu))
        uploaded = sum(len(p) for p in photos) / n
        atlas = sum(s["atlas_bytes"] for s in states) / n
        # looks at photos that lie here, and at views that are drawn anew
        connection, per = serve.connect(), {}
        for name, times, path in (
            ("container", 2000, lambda k: f"/v1/photos/{ids[k % n]}/atlas"),
            ("page", 2000, lambda k: f"/view/{ids[k % n]}"),
            ("view of 640×480", 4 * n, lambda k: f"/v1/photos/{ids[k % n]}/view?w=640&h={480 + k // n}"),
        ):
            for k in range(n):
                connection.request("GET", path(k))
                connection.getresponse().read()
            was = spent(serve)
            for k in range(n, n + times):
                connection.request("GET", path(k))
                answer = connection.getresponse()
                answer.read()
                check(answer.status == 200, f"{name}: {answer.status}")
            per[name] = (spent(serve) - was) / times
        for server in (serve, work):
            server.remove()
        engine.kill()
        database.kill()
    table = Table("measured", "each")
    table.row("photo: processor where it is made, s", f"{work_s:.2f}")
    table.row("photo: processor where it is uploaded, s", f"{serve_s:.3f}")
    table.row("photo: bytes up / container", f"{uploaded / 1e3:.0f} / {atlas / 1e3:.0f} kB")
    for kind in ("writes", "reads", "lists", "deletions"):
        table.row(f"photo: {kind} of the store", f"{asked.get(kind, 0):.1f}")
    table.row("two nodes at rest: requests of the store a second", f"{sum(steady.values()):.2f}")
    for name, s in per.items():
        table.row(f"{name}: processor, ms", f"{1e3 * s:.2f}")
    rate, looks = PHOTOS / DAY, LOOKS / DAY
    print()
    table = Table("a million photos and a hundred million looks a day", "mean", f"busiest hour (× {PEAK:.0f})")
    for what, value, text in (
        ("photos a second", rate, "{:.1f}"),
        ("cores that make photos", rate * work_s, "{:.0f}"),
        ("cores that take uploads", rate * serve_s, "{:.1f}"),
        ("writes of the store a second", rate * asked.get("writes", 0), "{:.0f}"),
        ("reads of the store a second", rate * asked.get("reads", 0), "{:.0f}"),
        ("new in the store, GB a day", PHOTOS * (uploaded + 1.1 * atlas) / 1e9, "{:.0f}"),
        ("looks a second: a page and a container", looks, "{:.0f}"),
        ("cores for them without a cache in front", looks * (per["container"] + per["page"]), "{:.1f}"),
        ("Gbit/s of containers", looks * atlas * 8 / 1e9, "{:.1f}"),
        ("cores where a look is a view drawn by the server", looks * per["view of 640×480"], "{:.0f}"),
    ):
        peak = text.format(value * PEAK) if "a day" not in what else ""
        table.row(what, text.format(value), peak)
    end()


main()
