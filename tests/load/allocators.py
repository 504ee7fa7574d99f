#!/usr/bin/env python3
"""Compares allocators by CPU time of uncached views and of containers, from one connection and from many, and by idle resident memory. Runs glibc with
several numbers of arenas, and jemalloc and mimalloc if the Debian packages are installed."""
import argparse, glob, statistics, threading, time
from common import Server, Table, check, finish, smooth

# seconds until idle caches are freed
REST = 4


def allocators():
    yield "glibc, default of tmpi", {}
    yield "glibc, 2 arenas", {"MALLOC_ARENA_MAX": "2"}
    yield "glibc, its default number of arenas", {"MALLOC_ARENA_MAX": "0"}
    yield "glibc, trims from 1 MiB on", {"MALLOC_ARENA_MAX": "0", "MALLOC_TRIM_THRESHOLD_": str(1 << 20), "MALLOC_MMAP_THRESHOLD_": str(1 << 20)}
    for name in ("jemalloc", "mimalloc"):
        for path in sorted(glob.glob(f"/usr/lib/*/lib{name}.so.?*"))[:1]:
            yield name, {"LD_PRELOAD": path}


def cpu_seconds(pid):
    fields = open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100


def fetch(server, path, times):
    connection = server.connect()
    for _ in range(times):
        connection.request("GET", path)
        answer = connection.getresponse()
        answer.read()
        check(answer.status == 200, f"{path}: {answer.status}")
    connection.close()


def fetch_in_parallel(server, paths, times):
    threads = [threading.Thread(target=fetch, args=(server, path, times)) for path in paths]
    for t in threads:
        t.start()
    for t in threads:
        t.join()


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    rounds = 9 if args.parse_args().full else 3
    running = {}
    for name, env in allocators():
        # the cache holds one scene, so a view of another photo decodes its container
        server = Server("--set", "cache.scenes=1", "--set", f"limits.idle={REST}", env=env)
        time.sleep(1)
        idle, photos = server.resident_mib(), []
        for seed in range(4):
            status, answer = server.upload(smooth(2, seed=seed))
            check(status in (201, 202) and server.wait(answer["id"])["state"] == "done", f"{name}: {status}")
            photos.append(f"/v1/photos/{answer['id']}")
        running[name] = server, photos, idle, ([], [], [])
    # alternate between servers, so that other load affects all of them equally
    for r in range(rounds):
        for server, photos, _, times in running.values():
            workloads = (
                lambda: [fetch(server, f"{photos[n % 4]}/view?w=640&h={400 + 12 * r + n}", 1) for n in range(12)],
                lambda: fetch(server, f"{photos[0]}/atlas", 600),
                lambda: fetch_in_parallel(server, [f"{photos[n % 4]}/atlas" for n in range(16)], 60),
            )
            for samples, run in zip(times, workloads):
                before = cpu_seconds(server.process.pid)
                run()
                samples.append(1e3 * (cpu_seconds(server.process.pid) - before))
    time.sleep(2.5 * REST)
    table = Table("allocator", "12 views, ms", "600 containers, ms", "960 containers over 16 connections, ms", "resident before / idle again, MiB")
    for name, (server, _, idle, times) in running.items():
        table.row(name, *(f"{statistics.median(t):.0f}" for t in times), f"{idle:.0f} / {server.resident_mib():.0f}")
    for server, *_ in running.values():
        server.remove()
    finish()


main()
