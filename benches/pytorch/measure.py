"""The PyTorch side of `compare`: times one piece of work, or writes weights, a batch and results for the other side.

    measure.py time WORK PRESET HEIGHT WIDTH BATCH THREADS LAYOUT ITERATIONS    one JSON object on standard output
    measure.py export FILE PRESET HEIGHT WIDTH BATCH                           a safetensors file

WORK is step, infer or conv; LAYOUT default, channels_last or compile (the default layout through torch.compile).
"""
import json
import resource
import struct
import sys
import time

import torch
import torch.nn.functional as F

from monovit_torch import BASE, NANO, SMALL, TINY, XSMALL, MonoViT, step_loss

PRESETS = {"nano": NANO, "tiny": TINY, "xsmall": XSMALL, "small": SMALL, "base": BASE}
WARM_UP = 3


def batch(height, width, count):
    """Smooth random pictures: target, previous, next; the target's pyramid; intrinsics."""
    def picture():
        return F.interpolate(torch.rand(count, 3, height // 8, width // 8), (height, width), mode="bilinear")
    target, prev, nxt = picture(), picture(), picture()
    pyramid = [target] + [F.interpolate(target, (height >> k, width >> k), mode="area") for k in (1, 2, 3)]
    k = torch.tensor([[0.58 * width, 0, 0.5 * width], [0, 1.92 * height, 0.5 * height], [0, 0, 1.0]])
    return pyramid, prev, nxt, k[None].repeat(count, 1, 1)


def step_of(model, layout, height, width, count):
    """A whole training step: zeroed gradients, four networks, four scales, the loss, backward, AdamW."""
    loss_of = torch.compile(step_loss) if layout == "compile" else step_loss
    pyramid, prev, nxt, k = batch(height, width, count)
    if layout == "channels_last":
        pyramid = [x.contiguous(memory_format=torch.channels_last) for x in pyramid]
        prev, nxt = (x.contiguous(memory_format=torch.channels_last) for x in (prev, nxt))
    rest = [p for part in (model.depth, model.pose_encoder, model.pose) for p in part.parameters()]
    groups = [{"params": list(model.encoder.parameters()), "lr": 5e-5}, {"params": rest, "lr": 1e-4}]
    optimiser = torch.optim.AdamW(groups)

    def once():
        optimiser.zero_grad()
        loss_of(model, pyramid, prev, nxt, k).backward()
        optimiser.step()
    return once


def inference_of(model, layout, height, width, count):
    """The four disparities of a batch of pictures."""
    model.eval()
    disparities = torch.compile(model.disp) if layout == "compile" else model.disp
    x = batch(height, width, count)[0][0]
    if layout == "channels_last":
        x = x.contiguous(memory_format=torch.channels_last)

    def once():
        with torch.inference_mode():
            disparities(x)
    return once


def convolution_of(layout):
    """A 3x3 convolution of two pictures of 320x320 with 3 channels to 16, forward."""
    x, w = torch.rand(2, 3, 320, 320), torch.rand(16, 3, 3, 3)
    if layout == "channels_last":
        x, w = (t.contiguous(memory_format=torch.channels_last) for t in (x, w))
    convolve = torch.compile(F.conv2d) if layout == "compile" else F.conv2d

    def once():
        with torch.inference_mode():
            convolve(x, w, padding=1)
    return once


def measure(work, preset, height, width, count, threads, layout, iterations):
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    if work == "conv":
        once = convolution_of(layout)
    else:
        model = MonoViT(PRESETS[preset])
        if layout == "channels_last":
            model = model.to(memory_format=torch.channels_last)
        once = (step_of if work == "step" else inference_of)(model, layout, height, width, count)
    start = time.perf_counter()
    once()
    first = time.perf_counter() - start
    for _ in range(WARM_UP - 1):
        once()
    seconds = []
    for _ in range(iterations):
        start = time.perf_counter()
        once()
        seconds.append(time.perf_counter() - start)
    return {
        "seconds": seconds,
        "first": first,
        "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "torch": torch.__version__,
        "capability": torch.backends.cpu.get_cpu_capability(),
    }


def write_safetensors(path, tensors, metadata):
    """Eight bytes of header length, the header as JSON, then the numbers, little-endian."""
    header, parts, at = {"__metadata__": metadata}, [], 0
    for name, tensor in tensors.items():
        numbers = tensor.detach().to(torch.float32).contiguous().numpy().astype("<f4").tobytes()
        header[name] = {"dtype": "F32", "shape": list(tensor.shape), "data_offsets": [at, at + len(numbers)]}
        parts.append(numbers)
        at += len(numbers)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as f:
        f.write(struct.pack("<Q", len(text)) + text + b"".join(parts))


def export(path, preset, height, width, count):
    torch.manual_seed(1)
    model = MonoViT(PRESETS[preset])
    pyramid, prev, nxt, k = batch(height, width, count)
    state = {name: t.clone() for name, t in model.state_dict().items() if not name.endswith("num_batches_tracked")}
    tensors = {f"weights/{name}": t for name, t in state.items()}
    tensors |= {"in/target": pyramid[0], "in/prev": prev, "in/next": nxt, "in/K": k[0]}
    tensors |= {f"in/pyramid/{s}": pyramid[s] for s in (1, 2, 3)}
    model.eval()
    with torch.inference_mode():
        tensors |= {f"out/inference/disp/{s}": d for s, d in enumerate(model.disp(pyramid[0]))}
    # With batch statistics from here on. Neither pass moves a weight.
    model.train()
    with torch.no_grad():
        tensors |= {f"out/disp/{s}": d for s, d in enumerate(model.disp(pyramid[0]))}
        tensors["out/loss"] = step_loss(model, pyramid, prev, nxt, k).reshape(1)
    x, w = torch.rand(2, 3, 320, 320), torch.rand(16, 3, 3, 3)
    tensors |= {"conv/x": x, "conv/w": w, "conv/y": F.conv2d(x, w, padding=1)}
    write_safetensors(path, tensors, {"preset": preset})


if __name__ == "__main__":
    command, *rest = sys.argv[1:] or ["help"]
    if command == "time" and len(rest) == 8:
        work, preset, height, width, count, threads, layout, iterations = rest
        found = measure(work, preset, int(height), int(width), int(count), int(threads), layout, int(iterations))
        print(json.dumps(found))
    elif command == "export" and len(rest) == 5:
        export(rest[0], rest[1], *map(int, rest[2:]))
    else:
        sys.exit(__doc__)
