"""Trains the reduced configuration with PyTorch on frames in the KITTI raw layout and scores it: the reference for a
training run. python train_torch.py TRAIN_DIR[,DIR...] VAL_DIR STEPS BATCH LR [EVERY]"""
import sys, os, glob, time, numpy as np, torch
from PIL import Image
from monovit_torch import *

def frames(root): return [sorted(glob.glob(d + "/image_02/data/*.png")) for d in sorted(glob.glob(root + "/*/*_sync"))]
def load(p, H, W):
    im = Image.open(p).convert("RGB")
    if im.size != (W, H): im = im.resize((W, H), Image.LANCZOS)
    return torch.from_numpy(np.array(im).astype(np.float32) / 255).permute(2, 0, 1)

def errors(gt, pr):
    t = np.maximum(gt / pr, pr / gt)
    return [np.mean(abs(gt - pr) / gt), np.mean((gt - pr) ** 2 / gt), np.sqrt(np.mean((gt - pr) ** 2)),
            np.sqrt(np.mean((np.log(gt) - np.log(pr)) ** 2)), (t < 1.25).mean(), (t < 1.25 ** 2).mean(), (t < 1.25 ** 3).mean()]

def score(m, val, H, W, const=None):
    out = []
    m.eval()
    with torch.no_grad():
        for p in val:
            z = np.array(Image.open(p.replace("image_02/data", "proj_depth/groundtruth/image_02"))).astype(np.float32) / 256
            d = m.disp(load(p, H, W)[None])[0] if const is None else const[None, None]
            pr = (1 / (0.01 + 9.99 * d))[0, 0].numpy()
            k = (z > 1e-3) & (z < 80)
            g, q = z[k], pr[k]
            q = np.clip(q * np.median(g) / np.median(q), 1e-3, 80)
            out.append(errors(g, q))
    m.train()
    return np.mean(out, 0)

if __name__ == "__main__":
    roots, vroot, steps, B, lr = sys.argv[1].split(","), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), float(sys.argv[5])
    every = int(sys.argv[6]) if len(sys.argv) > 6 else 250
    H, W = 96, 320
    torch.manual_seed(0); rng = np.random.default_rng(0)
    tri = [(f[i - 1], f[i], f[i + 1]) for r in roots for f in frames(r) for i in range(1, len(f) - 1)]
    val = [p for f in frames(vroot) for p in f[2::4]]
    cache = {}
    g = lambda p: cache.setdefault(p, load(p, H, W))
    m = MonoViT(NANO)
    opt = torch.optim.AdamW(m.parameters(), lr=lr, weight_decay=0.01)
    # a predictor that has learned nothing but the mean: inverse depth as a function of the row
    zs = [np.array(Image.open(p.replace("image_02/data", "proj_depth/groundtruth/image_02"))).astype(np.float32) / 256 for p in val]
    inv = np.mean([np.where(z > 0, 1 / np.maximum(z, 1e-3), 0.01) for z in zs], 0)
    const = torch.from_numpy(((inv - 0.01) / 9.99).clip(0, 1).astype(np.float32))
    print("mean-map predictor", np.round(score(m, val, H, W, const), 4), flush=True)
    print("triplets", len(tri), "val", len(val), "untrained", np.round(score(m, val, H, W), 4), flush=True)
    K = torch.tensor([[0.58 * W, 0, 0.5 * W], [0, 1.92 * H, 0.5 * H], [0, 0, 1.0]])[None].repeat(B, 1, 1)
    t0 = time.time(); run = []
    for it in range(1, steps + 1):
        for gr in opt.param_groups: gr["lr"] = lr * min(1, it / 100) * (0.1 if it > 0.75 * steps else 1)
        idx = rng.integers(len(tri), size=B)
        a, b, c = (torch.stack([g(tri[i][k]) for i in idx]) for k in range(3))
        if rng.random() < .5: a, b, c = a.flip(3), b.flip(3), c.flip(3)
        pyr = [b] + [F.interpolate(b, (H >> k, W >> k), mode="area") for k in (1, 2, 3)]
        noise = [torch.randn(B, 2, H, W) * 1e-5 for _ in range(4)]
        opt.zero_grad(); l = step_loss(m, pyr, a, c, K, noise); l.backward(); opt.step()
        run.append(l.item())
        if it % every == 0:
            print(it, "loss", round(float(np.mean(run[-every:])), 4), "s", round(time.time() - t0), np.round(score(m, val, H, W), 4), flush=True)
    torch.save(m.state_dict(), "trained.pt")
