"""How small an error of a gradient each checker notices, with the settings that each has by default.

    python benches/pytorch/detection.py        # PyTorch, JAX where it is installed, and `cargo bench --bench detection`

The functions, points and errors are those of benches/detection.rs; the points are drawn by another generator.
"""

import subprocess
import sys
from collections import defaultdict

import torch

FUNCTIONS = [
    ("x^2", lambda m, x: x * x),
    ("x^3", lambda m, x: x * x * x),
    ("sin", lambda m, x: m.sin(x)),
    ("exp", lambda m, x: m.exp(x)),
    ("tanh", lambda m, x: m.tanh(x)),
    ("1/(1+x^2)", lambda m, x: 1 / (1 + x * x)),
    ("ln(2+x)", lambda m, x: m.log(2 + x)),
    ("sqrt(2+x)", lambda m, x: m.sqrt(2 + x)),
    ("x sin x", lambda m, x: x * m.sin(x)),
    ("sin 10x", lambda m, x: m.sin(10 * x)),
    ("exp(-x^2)", lambda m, x: m.exp(-x * x)),
    ("softplus", lambda m, x: m.log1p(m.exp(x))),
]
POINTS, NUMBERS = 8, 5
ERRORS = [0.0, 1e-8, 1e-7, 3e-7, 1e-6, 1e-5, 1e-4, 1e-3, 3e-3, 1e-2, 1e-1]


def points(seed):
    return 3 * torch.rand(NUMBERS, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 1.5


def by_torch(f, x, one, error):
    class Wrong(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            ctx.save_for_backward(x)
            return f(torch, x)

        @staticmethod
        def backward(ctx, g):
            (x,) = ctx.saved_tensors
            with torch.enable_grad():
                x = x.detach().requires_grad_()
                (d,) = torch.autograd.grad(f(torch, x), x, g)
            d = d.clone()
            if one:
                d[0] += error * d.abs().max()
            else:
                d *= 1 + error
            return d

    return not torch.autograd.gradcheck(Wrong.apply, (x.requires_grad_(),), raise_exception=False)


def by_jax():
    import jax
    import jax.numpy as jnp
    from jax.test_util import check_grads

    jax.config.update("jax_enable_x64", True)

    def check(f, x, one, error):
        @jax.custom_vjp
        def wrong(x):
            return f(jnp, x)

        def forward(x):
            return f(jnp, x), x

        def backward(x, g):
            (d,) = jax.vjp(lambda x: f(jnp, x), x)[1](g)
            return (d.at[0].add(error * jnp.abs(d).max()) if one else d * (1 + error),)

        wrong.defvjp(forward, backward)
        try:
            check_grads(wrong, (jnp.asarray(x.numpy()),), order=1, modes=["rev"])
            return False
        except AssertionError:
            return True

    return check


def main():
    checkers = {"PyTorch": by_torch}
    try:
        checkers["JAX"] = by_jax()
    except ImportError:
        print("JAX is not installed", file=sys.stderr)
    table = defaultdict(dict)
    of = len(FUNCTIONS) * POINTS
    for name, check in checkers.items():
        for kind in ["all", "one"]:
            for error in ERRORS:
                runs = ((f, points(seed)) for _, f in FUNCTIONS for seed in range(POINTS))
                table[kind, error][name] = sum(check(f, x, kind == "one", error) for f, x in runs)
    ours = subprocess.run(["cargo", "bench", "-q", "--bench", "detection"], capture_output=True, text=True, check=True)
    for line in ours.stdout.splitlines():
        if line.startswith("parallax "):
            _, kind, error, count, _ = line.split()
            table[kind, float(error)]["parallax"] = int(count)
    names = ["parallax", *checkers]
    print(f"noticed, of {of}; PyTorch {torch.__version__}")
    print(f"{'what is off':12} {'by':>8} " + " ".join(f"{name:>9}" for name in names))
    for (kind, error), row in table.items():
        print(f"{kind:12} {error:8.0e} " + " ".join(f"{row.get(name, '-'):>9}" for name in names))


main()
