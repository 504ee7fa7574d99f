#!/usr/bin/env python3
"""Requests a million one-pixel views, abandons many more, then requests an ordinary view."""
import argparse, socket, threading, time
from common import Server, Table, Watch, check, depth_map, finish, small


def request_pixels(server, photo, first, count):
    """Requests distinct one-pixel views over one connection; returns counts by status."""
    answers, batch = {}, 64
    connection = socket.create_connection(server.address, 120)
    file = connection.makefile("rb")
    for at in range(first, first + count, batch):
        n = min(batch, first + count - at)
        requests = "".join(f"GET /v1/photos/{photo}/view?tx={(at + i) * 1e-9:.9f}&w=1&h=1 HTTP/1.1\r\nhost: localhost\r\n\r\n" for i in range(n))
        connection.sendall(requests.encode())
        for _ in range(n):
            status = file.readline().split(b" ")[1].decode()
            answers[status] = answers.get(status, 0) + 1
            length = 0
            while (line := file.readline()) != b"\r\n":
                if line.lower().startswith(b"content-length:"):
                    length = int(line.split(b":")[1])
            file.read(length)
    connection.close()
    return answers


def abandon(server, photo, first, count):
    for n in range(first, first + count):
        connection = socket.create_connection(server.address, 20)
        connection.sendall(f"GET /v1/photos/{photo}/view?ty={n * 1e-9:.9f}&w=640 HTTP/1.1\r\nhost: localhost\r\n\r\n".encode())
        connection.close()


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    server = Server()
    status, answer = server.upload(small(1), depth_map())
    check(server.wait(answer["id"])["state"] == "done", "the photo is made")
    photo = answer["id"]
    table = Table("requests", "count", "responses", "took", "per second", "others median", "worst", "not 200", "server", "resident after", "next view")

    def ordinary(n):
        began = time.monotonic()
        status, _, _ = server.get(f"/v1/photos/{photo}/view?tz={n * 1e-3}&w=1280&format=png", timeout=300)
        took = time.monotonic() - began
        check(status == 200 and took < 10, f"an ordinary view is fast: {status} after {took:.1f} s")
        return f"{status} in {took * 1e3:.0f} ms"

    table.row("before", "", "", "", "", "", "", "", f"{server.peak_mib()[0]:.0f} MiB", f"{server.resident_mib():.0f} MiB", ordinary(1))
    for n, (what, work, count) in enumerate((("one-pixel views", request_pixels, 1_000_000 if full else 20_000), ("abandoned views", abandon, 240_000 if full else 5_000)), 2):
        clients, answers = 8, {}
        with Watch(server) as watch:
            began = time.monotonic()

            def run(client):
                for status, times in (work(server, photo, client * count // clients, count // clients) or {}).items():
                    answers[status] = answers.get(status, 0) + times

            threads = [threading.Thread(target=run, args=(client,)) for client in range(clients)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            took = time.monotonic() - began
            view = ordinary(n)
        check(watch.failed == 0, f"/healthz responds during {what}")
        check(set(answers) <= {"200", "503"}, f"{what}: {answers}")
        check(server.resident_mib() < 600, f"the server takes {server.resident_mib():.0f} MiB after {what}")
        row = watch.row()
        row.pop("maker")
        table.row(what, count, answers or "", f"{took:.0f} s", f"{count / took:.0f}", *row.values(), f"{server.resident_mib():.0f} MiB", view)
    finish()


main()
