#!/usr/bin/env python3
"""Runs the whole server in a cgroup with a memory limit (root only). With 256 MB it makes 2 MP photos, reduced, and rejects 50 MP with the required
memory; with 1 GB it makes 50 MP. Resident memory then returns to about its idle value, and stays flat over many jobs, views and abandoned requests."""
import argparse, os, socket, time
from pathlib import Path
from common import Server, Table, check, children, depth_map, finish, skip, small, smooth, status_kib

V1, V2 = Path("/sys/fs/cgroup/memory"), Path("/sys/fs/cgroup")


class Group:
    """A cgroup with `mib` of memory and no swap."""

    def __init__(self, mib):
        self.v1 = V1.is_dir()
        self.path = (V1 if self.v1 else V2) / f"tmpi-{os.getpid()}-{mib}"
        self.path.mkdir()
        (self.path / ("memory.limit_in_bytes" if self.v1 else "memory.max")).write_text(str(mib << 20))
        if not self.v1:
            (self.path / "memory.swap.max").write_text("0")

    def peak_mib(self):
        return int((self.path / ("memory.max_usage_in_bytes" if self.v1 else "memory.peak")).read_text()) / (1 << 20)

    def oom_kills(self):
        text = (self.path / ("memory.oom_control" if self.v1 else "memory.events")).read_text()
        return next(int(line.split()[1]) for line in text.splitlines() if line.startswith("oom_kill "))

    def prefix(self):
        # the shell joins the group, then becomes the server
        return ["sh", "-c", f'echo $$ > {self.path}/cgroup.procs && exec "$0" "$@"']

    def remove(self):
        self.path.rmdir()


def resident(server):
    return sum(status_kib(pid, "VmRSS") for pid in [server.process.pid, *children(server.process.pid)]) / 1024


def run_within(table, mib, arguments, megapixels, makes_large):
    group = Group(mib)
    server = Server(*arguments, prefix=group.prefix())
    idle = resident(server)
    took = []
    for seed in range(5):
        began = time.monotonic()
        status, answer = server.upload(smooth(megapixels, seed=seed))
        if not check(status in (201, 202), f"{mib} MiB: the server accepts a photo of {megapixels} MP: {status} {answer.get('detail')}"):
            break
        state = server.wait(answer["id"])
        check(state["state"] == "done", f"{mib} MiB: a photo of {megapixels} MP is made: {state.get('error') or state['state']}")
        took.append(time.monotonic() - began)
        for path in ("atlas", "thumbnail", "view?w=640", "report"):
            status = server.get(f"/v1/photos/{answer['id']}/{path}")[0]
            check(status == 200, f"{mib} MiB: {path}: {status}")
    status, answer = server.upload(smooth(50), timeout=600)
    if makes_large:
        made = status in (201, 202) and server.wait(answer["id"])["state"]
        check(made == "done", f"{mib} MiB: 50 MP is made: {status} {answer.get('detail')} {made}")
        outcome = made
    else:
        outcome = f"{status}: {answer.get('detail')}"
        check(status == 413 and any(c.isdigit() for c in outcome[4:]), f"{mib} MiB: the server rejects 50 MP with the required memory: {outcome}")
    time.sleep(30)
    after = resident(server)
    check(after <= 1.1 * idle, f"{mib} MiB: resident {after:.0f} MiB after 30 s, {idle:.0f} MiB before")
    check(group.oom_kills() == 0, f"{mib} MiB: the kernel killed {group.oom_kills()} processes")
    table.row(f"{mib} MiB", f"{sum(took) / max(1, len(took)):.1f} s", outcome, f"{group.peak_mib():.0f} MiB", f"{idle:.0f} / {after:.0f} MiB", group.oom_kills())
    server.remove()
    time.sleep(0.5)
    group.remove()


def flat(table, jobs, views, abandoned):
    """Measures resident memory after each sixth of the work. Deletes the photos after each sixth: the index keeps about 2.4 kB per photo."""
    server = Server("--set", "limits.queue=100000")
    sizes, depth = [], depth_map()
    first, ids = None, []
    for part in range(6):
        for n in range(jobs // 6):
            status, answer = server.upload(small(part * jobs + n, 24, 16), depth)
            if not check(status in (201, 202), f"job {n}: {status} {answer.get('detail')}"):
                return
            first, ids = first or answer["id"], [*ids, answer["id"]]
        server.wait(answer["id"])
        while server.metric("tmpi_queue_depth") + server.metric("tmpi_jobs_running") > 0:
            time.sleep(0.1)
        connection = server.connect()
        for n in range(views // 6):
            view(connection, f"/v1/photos/{first}/view?w=16&tx={(part * views + n) / (views * 12):.7f}")
        for n in range(abandoned // 6):
            with socket.create_connection(server.address) as s:
                s.sendall(f"GET /v1/photos/{first}/view?w=64&ty={(part * abandoned + n) / (abandoned * 12):.7f} HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n".encode())
        for n, photo in enumerate(ids[1:]):
            status = server.request("DELETE", f"/v1/photos/{photo}")[0]
            check(status == 204, f"the server deletes photo {n}: {status}")
        ids = ids[:1]
        time.sleep(2)
        sizes.append(server.resident_mib())
    # the first parts fill the caches, which are bounded
    check(sizes[-1] <= 1.05 * sizes[2] + 4, f"memory grows: {sizes}")
    table.row(jobs, views, abandoned, " / ".join(f"{s:.0f}" for s in sizes))
    server.remove()


def view(connection, path):
    """Fetches a view over a kept-alive connection."""
    connection.request("GET", path)
    answer = connection.getresponse()
    answer.read()
    if not check(answer.status == 200, f"{path}: {answer.status}"):
        raise SystemExit("a view failed, so the measurement is invalid")


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    args.add_argument("--only", choices=["bounds", "flat"])
    args = args.parse_args()
    if args.only != "flat" and os.geteuid():
        skip("memory limits", "a cgroup needs root")
    elif args.only != "flat":
        table = Table("limit", "time for a photo", "50 MP", "peak", "resident idle / after 30 s", "OOM kills")
        run_within(table, 256, ("--memory", "256"), 2, False)
        run_within(table, 1024, ("--memory", "1024"), 2, True)
    if args.only != "bounds":
        table = Table("jobs", "views", "abandoned", "resident after each sixth, MiB")
        flat(table, *((10_000, 100_000, 10_000) if args.full else (300, 3_000, 300)))
    finish()


main()
