#!/usr/bin/env python3
"""Measures CPU time and store requests per photo and per page view, with one node that serves and one that makes photos on one S3 store (moto), and
estimates the cost of a million photos and a hundred million page views per day. Other work on the machine has little effect on CPU time."""
import argparse, collections, os, re, subprocess, tempfile, time
from pathlib import Path
import services
from common import Server, Table, check, children, finish, smooth

DAY = 86_400
PHOTOS, PAGE_VIEWS = 1_000_000, 100_000_000
# load of the busiest hour / mean load, typical of websites
PEAK = 3.0


def cpu_seconds(pid):
    fields = open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()
    # includes children that have exited
    return sum(int(f) for f in fields[11:15]) / os.sysconf("SC_CLK_TCK")


def total_cpu_seconds(server):
    return sum(cpu_seconds(pid) for pid in [server.process.pid, *children(server.process.pid)])


class StoreLog:
    """Counts requests to the store by kind, from its log."""

    KINDS = {"PUT": "writes", "POST": "writes", "GET": "reads", "HEAD": "reads", "DELETE": "deletions"}

    def __init__(self, path):
        self.path = path

    def counts(self):
        counts = collections.Counter()
        for method, target in re.findall(r'"(\w+) (\S+) HTTP', self.path.read_text()):
            counts["lists" if method == "GET" and "list-type" in target else self.KINDS.get(method, method)] += 1
        return counts


def start_store(folder):
    log = StoreLog(folder / "store.log")
    original_start = services.Engine.start

    def start(engine):
        engine.process = subprocess.Popen(engine.command, stdout=subprocess.DEVNULL, stderr=open(log.path, "a"), env=engine.env)
        services.wait_for_port(engine.port, engine.location.host)

    services.Engine.start = start
    engine = services.s3_server()
    services.Engine.start = original_start
    return engine, log


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--photos", metavar="FOLDER", help="folder of photos to upload (default: 2-megapixel pictures)")
    args.add_argument("--count", type=int, default=16)
    args = args.parse_args()
    photos = [p.read_bytes() for p in sorted(Path(args.photos).glob("*.jp*g"))[: args.count]] if args.photos else [smooth(2, seed=n) for n in range(args.count)]
    with tempfile.TemporaryDirectory(prefix="tmpi-load-") as folder:
        engine, log = start_store(Path(folder))
        env = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{engine.port}", "AWS_ALLOW_HTTP": "true", "AWS_REGION": "us-east-1", "AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test"}
        database = services.Postgres(Path(folder))
        options = ("--database", database.url, "--blobs", "s3://photos/tmpi", "--set", "limits.queue=1000")
        serve, work = Server(*options, "--role", "serve", env=env), Server(*options, "--role", "work", env=env)
        # the first photo loads networks and libraries
        status, first = serve.upload(smooth(0.1))
        check(status == 202 and serve.wait(first["id"])["state"] == "done", f"the first photo: {status} {first}")
        before, idle = log.counts(), 20
        time.sleep(idle)
        steady = {kind: (n - before[kind]) / idle for kind, n in log.counts().items()}
        before, cpu, start = log.counts(), (total_cpu_seconds(serve), total_cpu_seconds(work)), time.monotonic()
        ids = []
        for photo in photos:
            status, answer = serve.upload(photo)
            if check(status == 202, f"the server accepts an upload: {status} {answer.get('detail')}"):
                ids.append(answer["id"])
        states = [serve.wait(i) for i in ids]
        check(all(s["state"] == "done" for s in states), "all photos are made")
        took, n = time.monotonic() - start, len(ids)
        requests = {kind: max(0.0, (count - before[kind] - steady.get(kind, 0) * took) / n) for kind, count in log.counts().items()}
        serve_s, work_s = ((total_cpu_seconds(server) - was) / n for server, was in zip((serve, work), cpu))
        uploaded = sum(len(p) for p in photos) / n
        atlas = sum(s["atlas_bytes"] for s in states) / n
        # cached containers and pages, and views that the server must draw
        connection, cpu_per_request = serve.connect(), {}
        for name, times, path in (
            ("container", 2000, lambda k: f"/v1/photos/{ids[k % n]}/atlas"),
            ("page", 2000, lambda k: f"/view/{ids[k % n]}"),
            ("view of 640×480", 4 * n, lambda k: f"/v1/photos/{ids[k % n]}/view?w=640&h={480 + k // n}"),
        ):
            for k in range(n):
                connection.request("GET", path(k))
                connection.getresponse().read()
            was = total_cpu_seconds(serve)
            for k in range(n, n + times):
                connection.request("GET", path(k))
                answer = connection.getresponse()
                answer.read()
                check(answer.status == 200, f"{name}: {answer.status}")
            cpu_per_request[name] = (total_cpu_seconds(serve) - was) / times
        for server in (serve, work):
            server.remove()
        engine.kill()
        database.kill()
    table = Table("measured", "value")
    table.row("photo: CPU on the node that makes it, s", f"{work_s:.2f}")
    table.row("photo: CPU on the node that takes the upload, s", f"{serve_s:.3f}")
    table.row("photo: bytes of upload / container", f"{uploaded / 1e3:.0f} / {atlas / 1e3:.0f} kB")
    for kind in ("writes", "reads", "lists", "deletions"):
        table.row(f"photo: store {kind}", f"{requests.get(kind, 0):.1f}")
    table.row("two idle nodes: store requests per second", f"{sum(steady.values()):.2f}")
    for name, s in cpu_per_request.items():
        table.row(f"{name}: CPU, ms", f"{1e3 * s:.2f}")
    rate, views = PHOTOS / DAY, PAGE_VIEWS / DAY
    print()
    table = Table("a million photos and a hundred million page views per day", "mean", f"busiest hour (× {PEAK:.0f})")
    for what, value, text in (
        ("photos per second", rate, "{:.1f}"),
        ("cores that make photos", rate * work_s, "{:.0f}"),
        ("cores that accept uploads", rate * serve_s, "{:.1f}"),
        ("store writes per second", rate * requests.get("writes", 0), "{:.0f}"),
        ("store reads per second", rate * requests.get("reads", 0), "{:.0f}"),
        ("new in the store, GB per day", PHOTOS * (uploaded + 1.1 * atlas) / 1e9, "{:.0f}"),
        ("page views per second: a page and a container", views, "{:.0f}"),
        ("cores for page views without a cache in front", views * (cpu_per_request["container"] + cpu_per_request["page"]), "{:.1f}"),
        ("Gbit/s of containers", views * atlas * 8 / 1e9, "{:.1f}"),
        ("cores if the server draws each view", views * cpu_per_request["view of 640×480"], "{:.0f}"),
    ):
        peak = text.format(value * PEAK) if "per day" not in what else ""
        table.row(what, text.format(value), peak)
    finish()


main()
