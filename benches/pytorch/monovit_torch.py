"""An independent PyTorch statement of MonoViT, used only as an oracle for parity and as the reference for speed.

Parameter names follow the public checkpoints' state dicts, so one safetensors file serves both sides.
Checked against the public network code by check_against_public.py (never committed with that code).
"""
from dataclasses import dataclass, field
import torch, math
from torch import nn
import torch.nn.functional as F


@dataclass
class Cfg:
    dims: list = field(default_factory=lambda: [64, 128, 216, 288])
    layers: list = field(default_factory=lambda: [1, 3, 6, 3])
    paths: list = field(default_factory=lambda: [2, 3, 3, 3])
    heads: list = field(default_factory=lambda: [8, 8, 8, 8])
    mlp: list = field(default_factory=lambda: [4, 4, 4, 4])
    windows: dict = field(default_factory=lambda: {3: 2, 5: 3, 7: 3})
    drop_path: float = 0.0
    dec_in: list = field(default_factory=lambda: [64, 64, 128, 256, 512])
    dec: list = field(default_factory=lambda: [16, 32, 64, 128, 256])
    reduction: int = 16
    pose_width: int = 64
    pose_squeeze: int = 256

    @property
    def enc_out(self):
        d = self.dims
        return [d[0], d[1], d[2], d[3], d[3]]


SMALL = Cfg()
TINY = Cfg(dims=[64, 96, 176, 216], layers=[1, 2, 4, 1], mlp=[2, 2, 2, 2])
XSMALL = Cfg(dims=[64, 128, 192, 256], layers=[1, 2, 4, 1])
# the reduced configuration: same topology, an eighth of the arithmetic
# The decoder's widths all follow from one number w = dims[0], since the stem's feature goes in unmodified and each
# node's output must fit the next node's input: dec_in = [w, w, 2w, 4w, 8w], dec = [w/4, w/2, w, 2w, 4w].
def decoder_widths(w):
    return dict(dec_in=[w, w, 2 * w, 4 * w, 8 * w], dec=[w // 4, w // 2, w, 2 * w, 4 * w])


NANO = Cfg(dims=[32, 48, 64, 96], layers=[1, 1, 2, 1], mlp=[2, 2, 2, 2], **decoder_widths(32), reduction=8,
           pose_width=16, pose_squeeze=64)
BASE = Cfg(dims=[128, 224, 368, 480], layers=[1, 3, 8, 3], **decoder_widths(128))


class ConvBN(nn.Module):
    def __init__(s, i, o, k=1, st=1, p=0, act=False):
        super().__init__()
        s.conv = nn.Conv2d(i, o, k, st, p, bias=False)
        s.bn = nn.BatchNorm2d(o)
        s.act = act

    def forward(s, x):
        x = s.bn(s.conv(x))
        return F.hardswish(x) if s.act else x


class PatchConv(nn.Module):
    def __init__(s, c, st):
        super().__init__()
        s.dwconv = nn.Conv2d(c, c, 3, st, 1, groups=c, bias=False)
        s.pwconv = nn.Conv2d(c, c, 1, bias=False)
        s.bn = nn.BatchNorm2d(c)

    def forward(s, x):
        return F.hardswish(s.bn(s.pwconv(s.dwconv(x))))


class Embed(nn.Module):
    def __init__(s, c, st):
        super().__init__()
        s.patch_conv = PatchConv(c, st)

    def forward(s, x):
        return s.patch_conv(x)


class EmbedStage(nn.Module):
    def __init__(s, c, n):
        super().__init__()
        s.patch_embeds = nn.ModuleList([Embed(c, 2 if i == 0 else 1) for i in range(n)])

    def forward(s, x):
        out = []
        for e in s.patch_embeds:
            x = e(x)
            out.append(x)
        return out


class CPE(nn.Module):
    def __init__(s, c):
        super().__init__()
        s.proj = nn.Conv2d(c, c, 3, 1, 1, groups=c)

    def forward(s, x, hw):
        B, N, C = x.shape
        f = x.transpose(1, 2).reshape(B, C, *hw)
        return (s.proj(f) + f).flatten(2).transpose(1, 2)


class CRPE(nn.Module):
    def __init__(s, ch, heads, windows):
        super().__init__()
        s.conv_list = nn.ModuleList([nn.Conv2d(n * ch, n * ch, k, 1, k // 2, groups=n * ch) for k, n in windows.items()])
        s.split = [n * ch for n in windows.values()]

    def forward(s, q, v, hw):
        B, h, N, Ch = q.shape
        img = v.transpose(2, 3).reshape(B, h * Ch, *hw)
        o = torch.cat([c(t) for c, t in zip(s.conv_list, torch.split(img, s.split, 1))], 1)
        return q * o.reshape(B, h, Ch, N).transpose(2, 3)


class Att(nn.Module):
    def __init__(s, c, heads, crpe):
        super().__init__()
        s.h = heads
        s.qkv = nn.Linear(c, 3 * c)
        s.proj = nn.Linear(c, c)
        s.crpe = crpe

    def forward(s, x, hw):
        B, N, C = x.shape
        q, k, v = s.qkv(x).reshape(B, N, 3, s.h, C // s.h).permute(2, 0, 3, 1, 4)
        ctx = k.softmax(2).transpose(2, 3) @ v
        y = (C // s.h) ** -0.5 * (q @ ctx) + s.crpe(q, v, hw)
        return s.proj(y.transpose(1, 2).reshape(B, N, C))


class Mlp(nn.Module):
    def __init__(s, c, r):
        super().__init__()
        s.fc1 = nn.Linear(c, c * r)
        s.fc2 = nn.Linear(c * r, c)

    def forward(s, x):
        return s.fc2(F.gelu(s.fc1(x)))


def drop_path(x, p, training):
    if p == 0 or not training:
        return x
    m = torch.empty(x.shape[0], *([1] * (x.dim() - 1))).bernoulli_(1 - p) / (1 - p)
    return x * m


class Block(nn.Module):
    def __init__(s, c, heads, r, cpe, crpe, dp):
        super().__init__()
        s.cpe, s.crpe, s.dp = cpe, crpe, dp
        s.factoratt_crpe = Att(c, heads, crpe)
        s.mlp = Mlp(c, r)
        s.norm1 = nn.LayerNorm(c, eps=1e-6)
        s.norm2 = nn.LayerNorm(c, eps=1e-6)

    def forward(s, x, hw):
        x = s.cpe(x, hw)
        x = x + drop_path(s.factoratt_crpe(s.norm1(x), hw), s.dp, s.training)
        return x + drop_path(s.mlp(s.norm2(x)), s.dp, s.training)


class Encoder1(nn.Module):
    def __init__(s, c, n, heads, r, windows, dps):
        super().__init__()
        s.cpe = CPE(c)
        s.crpe = CRPE(c // heads, heads, windows)
        s.MHCA_layers = nn.ModuleList([Block(c, heads, r, s.cpe, s.crpe, dps[i]) for i in range(n)])

    def forward(s, x, hw):
        B = x.shape[0]
        for l in s.MHCA_layers:
            x = l(x, hw)
        return x.transpose(1, 2).reshape(B, -1, *hw)


class InvRes(nn.Module):
    def __init__(s, c):
        super().__init__()
        s.conv1 = ConvBN(c, c, act=True)
        s.dwconv = nn.Conv2d(c, c, 3, 1, 1, groups=c, bias=False)
        s.norm = nn.BatchNorm2d(c)
        s.conv2 = ConvBN(c, c)

    def forward(s, x):
        return x + s.conv2(F.hardswish(s.norm(s.dwconv(s.conv1(x)))))


class Stage(nn.Module):
    def __init__(s, c, o, n, heads, r, paths, windows, dps):
        super().__init__()
        s.mhca_blks = nn.ModuleList([Encoder1(c, n, heads, r, windows, dps) for _ in range(paths)])
        s.InvRes = InvRes(c)
        s.aggregate = ConvBN(c * (paths + 1), o, act=True)

    def forward(s, xs):
        out = [s.InvRes(xs[0])]
        for x, e in zip(xs, s.mhca_blks):
            out.append(e(x.flatten(2).transpose(1, 2), tuple(x.shape[2:])))
        return s.aggregate(torch.cat(out, 1))


class MPViT(nn.Module):
    def __init__(s, c: Cfg):
        super().__init__()
        d = c.dims
        s.stem = nn.Sequential(ConvBN(3, d[0] // 2, 3, 2, 1, True), ConvBN(d[0] // 2, d[0], 3, 1, 1, True))
        s.patch_embed_stages = nn.ModuleList([EmbedStage(d[i], c.paths[i]) for i in range(4)])
        dpr = torch.linspace(0, c.drop_path, sum(c.layers)).tolist()
        cur, st = 0, []
        for i in range(4):
            st.append(Stage(d[i], d[min(i + 1, 3)], c.layers[i], c.heads[i], c.mlp[i], c.paths[i], c.windows,
                            dpr[cur:cur + c.layers[i]]))
            cur += c.layers[i]
        s.mhca_stages = nn.ModuleList(st)

    def forward(s, x):
        x = s.stem(x)
        out = [x]
        for e, m in zip(s.patch_embed_stages, s.mhca_stages):
            x = m(e(x))
            out.append(x)
        return out


class Conv3(nn.Module):
    def __init__(s, i, o):
        super().__init__()
        s.conv = nn.Conv2d(i, o, 3)

    def forward(s, x):
        return s.conv(F.pad(x, (1, 1, 1, 1), mode="reflect"))


class ConvELU(nn.Module):
    def __init__(s, i, o):
        super().__init__()
        s.conv = Conv3(i, o)

    def forward(s, x):
        return F.elu(s.conv(x))


class Conv1(nn.Module):
    def __init__(s, i, o):
        super().__init__()
        s.conv = nn.Conv2d(i, o, 1, bias=False)

    def forward(s, x):
        return s.conv(x)


class SE(nn.Module):
    """channel attention: x * sigmoid(fc(avgpool x))"""

    def __init__(s, c, r):
        super().__init__()
        s.fc = nn.Sequential(nn.Linear(c, c // r, bias=False), nn.ReLU(), nn.Linear(c // r, c, bias=False))

    def forward(s, x):
        return x * torch.sigmoid(s.fc(x.mean((2, 3))))[:, :, None, None]


class AttMod(nn.Module):
    def __init__(s, i, o, r):
        super().__init__()
        s.ca = SE(i, r)
        s.conv_se = nn.Conv2d(i, o, 3, 1, 1)

    def forward(s, x):
        return F.relu(s.conv_se(s.ca(x)))


class FSE(nn.Module):
    def __init__(s, hi, lo, r):
        super().__init__()
        c = hi + lo
        s.fc = nn.Sequential(nn.Linear(c, c // r, bias=False), nn.ReLU(), nn.Linear(c // r, c, bias=False))
        s.conv_se = nn.Conv2d(c, hi, 1)

    def forward(s, high, low):
        x = torch.cat([up(high)] + low, 1)
        x = x * torch.sigmoid(s.fc(x.mean((2, 3))))[:, :, None, None]
        return F.relu(s.conv_se(x))


def up(x):
    return F.interpolate(x, scale_factor=2, mode="nearest")


class Decoder(nn.Module):
    POS = ["01", "11", "21", "31", "02", "12", "22", "03", "13", "04"]
    ATT = ["31", "22", "13", "04"]

    def __init__(s, c: Cfg):
        super().__init__()
        e, d, r, ch = c.dec_in, c.dec, c.reduction, c.enc_out
        m = {f"f{i}": AttMod(ch[i], e[i], r) for i in (4, 3, 2, 1)}
        for j in range(5):
            for i in range(5 - j):
                ni = e[i] // 2 if i == 0 and j else e[i]
                m[f"X_{i}{j}_Conv_0"] = ConvELU(ni, ni // 2)
                if i == 0 and j == 4:
                    m["X_04_Conv_1"] = ConvELU(ni // 2, d[0])
        for p in s.ATT:
            i, j = int(p[0]), int(p[1])
            m[f"X_{p}_attention"] = FSE(e[i + 1] // 2, e[i] + d[i + 1] * (j - 1), r)
        for p in s.POS:
            if p in s.ATT:
                continue
            i, j = int(p[0]), int(p[1])
            if j == 1:
                m[f"X_{i+1}{j-1}_Conv_1"] = ConvELU(e[i + 1] // 2 + e[i], d[i + 1])
            else:
                m[f"X_{p}_downsample"] = Conv1(e[i + 1] // 2 + e[i] + d[i + 1] * (j - 1), d[i + 1] * 2)
                m[f"X_{i+1}{j-1}_Conv_1"] = ConvELU(d[i + 1] * 2, d[i + 1])
        for i in range(4):
            m[f"dispconv{i}"] = Conv3(d[i], 1)
        s.convs = nn.ModuleDict(m)

    def forward(s, feats):
        c = s.convs
        X = {f"{i}0": (feats[i] if i == 0 else c[f"f{i}"](feats[i])) for i in range(5)}
        for p in s.POS:
            i, j = int(p[0]), int(p[1])
            low = [X[f"{i}{k}"] for k in range(j)]
            h = X[f"{i+1}{j-1}"]
            h = c[f"X_{i+1}{j-1}_Conv_0"](h)
            if p in s.ATT:
                X[p] = c[f"X_{p}_attention"](h, low)
            else:
                z = torch.cat([up(h)] + low, 1)
                if j != 1:
                    z = c[f"X_{p}_downsample"](z)
                X[p] = c[f"X_{i+1}{j-1}_Conv_1"](z)
        x = c["X_04_Conv_1"](up(c["X_04_Conv_0"](X["04"])))
        return [torch.sigmoid(c[f"dispconv{k}"](t)) for k, t in enumerate([x, X["04"], X["13"], X["22"]])]


class Basic(nn.Module):
    def __init__(s, i, o, st):
        super().__init__()
        s.conv1 = nn.Conv2d(i, o, 3, st, 1, bias=False)
        s.bn1 = nn.BatchNorm2d(o)
        s.conv2 = nn.Conv2d(o, o, 3, 1, 1, bias=False)
        s.bn2 = nn.BatchNorm2d(o)
        if st != 1 or i != o:
            s.downsample = nn.Sequential(nn.Conv2d(i, o, 1, st, bias=False), nn.BatchNorm2d(o))
        else:
            s.downsample = None

    def forward(s, x):
        y = s.bn2(s.conv2(F.relu(s.bn1(s.conv1(x)))))
        return F.relu(y + (x if s.downsample is None else s.downsample(x)))


class ResNet18(nn.Module):
    def __init__(s, inp, w):
        super().__init__()
        s.conv1 = nn.Conv2d(inp, w, 7, 2, 3, bias=False)
        s.bn1 = nn.BatchNorm2d(w)
        for k, (i, o) in enumerate([(w, w), (w, 2 * w), (2 * w, 4 * w), (4 * w, 8 * w)]):
            setattr(s, f"layer{k+1}", nn.Sequential(Basic(i, o, 1 if k == 0 else 2), Basic(o, o, 1)))

    def forward(s, x):
        x = F.relu(s.bn1(s.conv1((x - 0.45) / 0.225)))
        f = [x]
        x = F.max_pool2d(x, 3, 2, 1)
        for k in range(4):
            x = getattr(s, f"layer{k+1}")(x)
            f.append(x)
        return f


class PoseEnc(nn.Module):
    def __init__(s, w):
        super().__init__()
        s.encoder = ResNet18(6, w)

    def forward(s, x):
        return s.encoder(x)


class PoseDec(nn.Module):
    def __init__(s, c, q):
        super().__init__()
        s.net = nn.ModuleList([nn.Conv2d(c, q, 1), nn.Conv2d(q, q, 3, 1, 1), nn.Conv2d(q, q, 3, 1, 1), nn.Conv2d(q, 12, 1)])

    def forward(s, f):
        x = F.relu(s.net[0](f))
        x = F.relu(s.net[1](x))
        x = F.relu(s.net[2](x))
        x = 0.01 * s.net[3](x).mean((2, 3)).view(-1, 2, 6)
        return x[:, 0, :3], x[:, 0, 3:]


class MonoViT(nn.Module):
    def __init__(s, c: Cfg):
        super().__init__()
        s.encoder, s.depth = MPViT(c), Decoder(c)
        s.pose_encoder, s.pose = PoseEnc(c.pose_width), PoseDec(8 * c.pose_width, c.pose_squeeze)

    def disp(s, x):
        return s.depth(s.encoder(x))

    def rel_pose(s, a, b):
        return s.pose(s.pose_encoder(torch.cat([a, b], 1))[-1])


def rodrigues(v):
    """exact exponential map, right in value and gradient at v = 0: R = I + a [v]x + b [v]x^2, a = sin t / t, b = (1 - cos t) / t^2"""
    t2 = (v * v).sum(1)[:, None, None]
    small = t2 < 1e-4
    t = torch.sqrt(torch.where(small, torch.ones_like(t2), t2))
    a = torch.where(small, 1 - t2 / 6 + t2 ** 2 / 120 - t2 ** 3 / 5040, torch.sin(t) / t)
    b = torch.where(small, 0.5 - t2 / 24 + t2 ** 2 / 720 - t2 ** 3 / 40320, (1 - torch.cos(t)) / (t * t))
    x, y, z = v[:, 0], v[:, 1], v[:, 2]
    o = torch.zeros_like(x)
    S = torch.stack([o, -z, y, z, o, -x, -y, x, o], 1).view(-1, 3, 3)
    return torch.eye(3, dtype=v.dtype) + a * S + b * (S @ S)


def pose_mat(aa, t, invert):
    R = rodrigues(aa)
    if invert:
        R = R.transpose(1, 2)
        t = -(R @ t[:, :, None])[:, :, 0]
    M = torch.zeros(aa.shape[0], 4, 4, dtype=aa.dtype)
    M[:, :3, :3] = R
    M[:, :3, 3] = t
    M[:, 3, 3] = 1
    return M


def disp_to_depth(d, lo=0.1, hi=100.0):
    return 1 / (1 / hi + (1 / lo - 1 / hi) * d)


def ssim(x, y):
    x, y = F.pad(x, (1, 1, 1, 1), mode="reflect"), F.pad(y, (1, 1, 1, 1), mode="reflect")
    P = lambda t: F.avg_pool2d(t, 3, 1)
    mx, my = P(x), P(y)
    sx, sy, sxy = P(x * x) - mx * mx, P(y * y) - my * my, P(x * y) - mx * my
    n = (2 * mx * my + 0.01 ** 2) * (2 * sxy + 0.03 ** 2)
    d = (mx * mx + my * my + 0.01 ** 2) * (sx + sy + 0.03 ** 2)
    return ((1 - n / d) / 2).clamp(0, 1)


def photometric(p, t):
    return 0.85 * ssim(p, t).mean(1, True) + 0.15 * (t - p).abs().mean(1, True)


def smooth(d, img):
    dx, dy = (d[..., :-1] - d[..., 1:]).abs(), (d[:, :, :-1] - d[:, :, 1:]).abs()
    ix = (img[..., :-1] - img[..., 1:]).abs().mean(1, True)
    iy = (img[:, :, :-1] - img[:, :, 1:]).abs().mean(1, True)
    return (dx * torch.exp(-ix)).mean() + (dy * torch.exp(-iy)).mean()


def warp(src, depth, K, T):
    B, _, H, W = src.shape
    yy, xx = torch.meshgrid(torch.arange(H, dtype=src.dtype), torch.arange(W, dtype=src.dtype), indexing="ij")
    pix = torch.stack([xx.reshape(-1), yy.reshape(-1), torch.ones(H * W, dtype=src.dtype)])[None]
    cam = depth.view(B, 1, -1) * (torch.inverse(K) @ pix)
    P = (K @ T[:, :3])
    q = P[:, :, :3] @ cam + P[:, :, 3:]
    uv = q[:, :2] / (q[:, 2:] + 1e-7)
    u, v = uv[:, 0].view(B, H, W), uv[:, 1].view(B, H, W)
    grid = torch.stack([(u / (W - 1) - 0.5) * 2, (v / (H - 1) - 0.5) * 2], -1)
    return F.grid_sample(src, grid, padding_mode="border", align_corners=False)


def total_loss(disps, pyr, srcs, Ts, K, noise=None, lam=1e-3):
    """pyr: target at 4 scales; srcs: source frames at full size; Ts: target->source poses"""
    tgt = pyr[0]
    H, W = tgt.shape[2:]
    ident = torch.cat([photometric(s, tgt) for s in srcs], 1)
    total = 0
    for k, d in enumerate(disps):
        depth = disp_to_depth(F.interpolate(d, (H, W), mode="bilinear", align_corners=False))
        rep = torch.cat([photometric(warp(s, depth, K, T), tgt) for s, T in zip(srcs, Ts)], 1)
        i = ident if noise is None else ident + noise[k]
        loss = torch.cat([i, rep], 1).min(1)[0].mean()
        nd = d / (d.mean((2, 3), True) + 1e-7)
        total = total + loss + lam * smooth(nd, pyr[k]) / 2 ** k
    return total / 4


def step_loss(m, pyr, prev, nxt, K, noise=None):
    disps = m.disp(pyr[0])
    aa1, t1 = m.rel_pose(prev, pyr[0])
    aa2, t2 = m.rel_pose(pyr[0], nxt)
    Ts = [pose_mat(aa1, t1, True), pose_mat(aa2, t2, False)]
    return total_loss(disps, pyr, [prev, nxt], Ts, K, noise)
