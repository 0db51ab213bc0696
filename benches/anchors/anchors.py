#!/usr/bin/env python3
"""Inference by parallax, ONNX Runtime, OpenVINO and PyTorch, and training steps by parallax and PyTorch, by turns.

Every network is this repository's own PyTorch model (../pytorch/monovit_torch.py), exported to ONNX here. First all must
agree with PyTorch on one picture: f32 to 1e-3 of the largest disparity, bf16 to 5e-2. Then each is timed in a process of
its own, round after round; the medians count. "start" is from the start of the process to the first disparity map in
hand. Ratios are the other's time over parallax's: above 1, parallax is faster. Give it a machine that does nothing else.

    PYTHON anchors.py                              # all rows, two threads, four rounds
    PYTHON anchors.py --rows nano,small --json anchors.json
"""
import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path.insert(0, str(HERE.parent / "pytorch"))

# name: preset, height, width, batch.
ROWS = {
    "nano": ("nano", 96, 320, 4),
    "tiny": ("tiny", 192, 640, 1),
    "small": ("small", 192, 640, 1),
    "base": ("base", 192, 640, 1),
    "tiny-1024": ("tiny", 320, 1024, 1),
    "small-1024": ("small", 320, 1024, 1),
    "base-1024": ("base", 320, 1024, 1),
}
STEPS = ["nano", "small"]
OTHERS = ["onnxruntime", "openvino-f32", "openvino-bf16", "torch", "torch-channels_last"]
BOUNDS = {"f32": 1e-3, "bf16": 5e-2}
WARM_UP = 3


def model_of(preset):
    """The network with weights of a fixed seed, as a module whose forward pass gives the largest disparity map."""
    import torch
    from measure import PRESETS
    from monovit_torch import MonoViT

    class Disparity(torch.nn.Module):
        def __init__(self, model):
            super().__init__()
            self.model = model

        def forward(self, x):
            return self.model.disp(x)[0]
    torch.manual_seed(1)
    return Disparity(MonoViT(PRESETS[preset])).eval()


def prepare(folder, preset, height, width, count):
    """The ONNX file, the weights, a picture and its disparity map by PyTorch, in a folder."""
    import numpy
    import torch
    from measure import batch, write_safetensors
    model = model_of(preset)
    torch.manual_seed(2)
    x = batch(height, width, count)[0][0]
    with torch.inference_mode():
        numpy.save(folder / "expected.npy", model(x).numpy())
    numpy.save(folder / "x.npy", x.numpy())
    state = model.model.state_dict().items()
    weights = {name: t for name, t in state if not name.endswith("num_batches_tracked")}
    write_safetensors(folder / "weights.safetensors", weights, {"preset": preset})
    torch.onnx.export(model, (x,), str(folder / "model.onnx"), input_names=["x"], output_names=["disparity"], dynamo=False,
                      opset_version=17)


def runner(engine, folder, preset, threads):
    """A function from a picture to its disparity map, by one of the engines."""
    if engine == "onnxruntime":
        import onnxruntime
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        session = onnxruntime.InferenceSession(str(folder / "model.onnx"), options, providers=["CPUExecutionProvider"])
        return lambda x: session.run(None, {"x": x})[0]
    if engine.startswith("openvino"):
        import openvino
        settings = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": engine.split("-")[1],
                    "PERFORMANCE_HINT": "LATENCY"}
        compiled = openvino.Core().compile_model(str(folder / "model.onnx"), "CPU", settings)
        request = compiled.create_infer_request()
        return lambda x: request.infer({0: x})[0]
    import torch
    torch.set_num_threads(threads)
    model = model_of(preset)
    layout = torch.channels_last if engine.endswith("channels_last") else torch.contiguous_format
    model = model.to(memory_format=layout)

    def run(x):
        with torch.inference_mode():
            return model(torch.from_numpy(x).contiguous(memory_format=layout)).numpy()
    return run


def work(engine, folder, preset, threads, iterations, began):
    """Runs in a process of its own; one JSON object on standard output."""
    import numpy
    x, expected = (numpy.load(folder / name) for name in ("x.npy", "expected.npy"))
    run = runner(engine, folder, preset, threads)
    found = run(x)
    start = time.time() - began
    error = float(numpy.abs(found - expected).max() / numpy.abs(expected).max())
    for _ in range(WARM_UP):
        run(x)
    seconds = []
    for _ in range(iterations):
        before = time.perf_counter()
        run(x)
        seconds.append(time.perf_counter() - before)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps({"seconds": seconds, "start": start, "error": error, "peak_rss_bytes": peak}))


def json_of(command):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"anchors: {' '.join(map(str, command))}:\n{done.stderr.strip()[-2000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def theirs(engine, folder, preset, args):
    command = [sys.executable, __file__, "--work", engine, "--folder", folder, "--preset", preset,
               "--threads", args.threads, "--iterations", args.iterations, "--began", time.time()]
    return json_of(command)


def ours(work_name, row, args, *more):
    preset, height, width, count = row
    return json_of([args.parallax, "--threads", args.threads, "bench", work_name, "--preset", preset, "--height", height,
                    "--width", width, "--batch", count, "--iterations", args.iterations, "--no-breakdown", "--json", *more])


def torch_step(layout, row, args):
    preset, height, width, count = map(str, row)
    return json_of([sys.executable, HERE.parent / "pytorch" / "measure.py", "time", "step", preset, height, width, count,
                    args.threads, layout, args.iterations])


def our_start(folder, row, args):
    """Seconds from the start of `parallax predict` to the end of it, with its first depth map on disk."""
    import numpy
    _, height, width, _ = row
    picture = folder / "picture.png"
    if not picture.exists():
        write_png(picture, (numpy.load(folder / "x.npy")[0].transpose(1, 2, 0) * 255).round().astype("uint8"))
    with tempfile.TemporaryDirectory(dir=folder) as out:
        before = time.perf_counter()
        done = subprocess.run([str(c) for c in [args.parallax, "--threads", args.threads, "predict", "--weights",
                               folder / "weights.safetensors", "--height", height, "--width", width, "--out", out, picture]],
                              capture_output=True, text=True)
        seconds = time.perf_counter() - before
    if done.returncode != 0:
        raise SystemExit(f"anchors: parallax predict: {done.stderr.strip()[-2000:]}")
    return seconds


def write_png(path, pixels):
    import struct
    import zlib
    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))


def agree(name, row, args, folder):
    """Ours against PyTorch by `bench agree`; the others by their own processes."""
    preset, height, width, count = map(str, row)
    file = folder / "agree.safetensors"
    done = subprocess.run([sys.executable, HERE.parent / "pytorch" / "measure.py", "export", file, preset, height, width,
                           count], capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"anchors: measure.py export: {done.stderr.strip()[-2000:]}")
    json_of([args.parallax, "bench", "agree", file])
    file.unlink()


def measure_row(name, args, results):
    row, found = ROWS[name], {}
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        prepare(folder, *row)
        agree(name, row, args, folder)
        for turn in range(args.rounds):
            for precision in ("f32", "bf16"):
                if precision == "f32" or args.bf16:
                    run = ours("infer", row, args, "--precision", precision)
                    run["start"] = our_start(folder, row, args) if precision == "f32" else None
                    found.setdefault(f"parallax-{precision}", []).append(run)
            for engine in OTHERS:
                run = theirs(engine, folder, row[0], args)
                bound = BOUNDS["bf16" if engine.endswith("bf16") else "f32"]
                # Written so that NaN does not pass.
                if not run["error"] <= bound:
                    raise SystemExit(f"anchors: {name}: {engine} differs from PyTorch by {run['error']:.1e} (> {bound})")
                found.setdefault(engine, []).append(run)
            print(f"{name}: round {turn + 1} of {args.rounds}", file=sys.stderr)
    results.append(summary(f"{name} inference", row, found))
    if name in STEPS:
        found = {}
        for _ in range(args.rounds):
            found.setdefault("parallax-f32", []).append(ours("step", row, args))
            for layout in ("default", "channels_last"):
                found.setdefault(f"torch-{layout}", []).append(torch_step(layout, row, args))
        results.append(summary(f"{name} step", row, found))


def summary(what, row, found):
    engines = {}
    for engine, runs in found.items():
        starts = [run["start"] for run in runs if run.get("start") is not None]
        engines[engine] = {
            "seconds": statistics.median(s for run in runs for s in run["seconds"]),
            "peak_rss_bytes": max(run["peak_rss_bytes"] for run in runs),
            "start": statistics.median(starts) if starts else None,
        }
    return {"what": what, "row": row, "engines": engines, "runs": found}


def table(results):
    lines = ["| | engine | time | over parallax's f32 | over its bf16 | peak memory | start |", "|---|---|---|---|---|---|---|"]
    for result in results:
        engines = result["engines"]
        for engine, e in engines.items():
            ratios = [f"{e['seconds'] / engines[o]['seconds']:.2f}" if o in engines else ""
                      for o in ("parallax-f32", "parallax-bf16")]
            start = f"{e['start']:.2f} s" if e["start"] is not None else ""
            lines.append(f"| {result['what']} | {engine} | {1e3 * e['seconds']:.1f} ms | {ratios[0]} | {ratios[1]} | "
                         f"{e['peak_rss_bytes'] / 2**20:.0f} MiB | {start} |")
    return "\n".join(lines)


def machine():
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return "unknown processor", False
    model = next((line.split(":")[1].strip() for line in text.splitlines() if line.startswith("model name")), "unknown")
    return model, " avx512_bf16" in text


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default=",".join(ROWS), help="some of " + ", ".join(ROWS))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--parallax", type=Path, default=ROOT / "target" / "release" / "parallax")
    parser.add_argument("--json", type=Path, help="file for every number")
    for hidden in ("--work", "--preset"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--began", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        return work(args.work, args.folder, args.preset, args.threads, args.iterations, args.began)
    rows = args.rows.split(",")
    unknown = [row for row in rows if row not in ROWS]
    if unknown:
        parser.error(f"no row {', '.join(unknown)}; there are {', '.join(ROWS)}")
    if not args.parallax.exists():
        parser.error(f"{args.parallax} is missing: cargo build --release, or --parallax FILE")
    processor, args.bf16 = machine()
    print(f"{processor}, {args.threads} threads, {args.rounds} rounds of {args.iterations}, {os.cpu_count()} processors")
    results = []
    for name in rows:
        measure_row(name, args, results)
        # What was measured is kept, whatever happens to the next row.
        if args.json:
            aside = args.json.with_name(args.json.name + ".part")
            aside.write_text(json.dumps({"processor": processor, "threads": args.threads, "results": results}, indent=1))
            aside.replace(args.json)
    print(table(results))


if __name__ == "__main__":
    main()
