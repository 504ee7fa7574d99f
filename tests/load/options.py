#!/usr/bin/env python3
"""All corners of the options on a noisy photo with a noisy map: what is accepted can be read, what is refused names the bound."""
import argparse, itertools, time
from common import Server, Table, check, end, noise


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--megapixels", type=float)
    args.add_argument("--full", action="store_true")
    args = args.parse_args()
    megapixels = args.megapixels or (12 if args.full else 0.2)
    photo, depth = noise(megapixels), noise(megapixels, 1, 16)
    server = Server("--set", "limits.job-timeout=3600", "--set", "limits.queue=4", "--set", "limits.request-timeout=600")
    table = Table("options", "answer", "ended as", "after", "maker", "atlas", "level", "view", "zip")
    corners = [
        dict(tile=tile, planes=planes, view_box=box, max_error=0)
        for tile, planes, box in itertools.product(("8", "16", "64", "1024", "full"), ("auto", "1", "16", "64"), ("0,0,0", "10,10,10"))
    ]
    corners += [dict(quality=q, denoise="off", snap=s, max_error=e) for q, s, e in ((1, "on", 1000), (100, "off", 0))]
    corners += [dict(fov_x=v) for v in (0.001, 179.999)] + [dict(max_size=v) for v in (1, 64)]
    corners += [dict(plane_method=m, planes=64) for m in ("linear", "lloyd", "optimal", "slanted")]
    for options in corners:
        began = time.monotonic()
        name = " ".join(f"{k}={v}" for k, v in options.items())
        status, answer = server.upload(photo, depth, **options)
        if status not in (201, 202):
            named = status in (400, 413) and answer.get("field") and any(c.isdigit() for c in answer.get("detail", ""))
            check(named, f"{name}: {status} {answer.get('detail')} names the bound")
            table.row(name, status, answer.get("detail", "")[:90])
            continue
        state = server.wait(answer["id"], 3600)
        took, maker = time.monotonic() - began, server.peak_mib()[1]
        check(state["state"] == "done", f"{name}: {state['state']} {state.get('problem')}")
        got = {}
        if state["state"] == "done":
            for part, path in dict(atlas="atlas", level="atlas?level=1", view="view?w=64", zip="export?format=zip").items():
                got[part] = server.get(f"/v1/photos/{answer['id']}/{path}", timeout=600)[0]
                check(got[part] == 200, f"{name}: {part} {got[part]}")
        server.request("DELETE", f"/v1/photos/{answer['id']}")
        table.row(name, status, state["state"], f"{took:.1f} s", f"{maker:.0f} MiB", *got.values())
    end()


main()
