#!/usr/bin/env python3
"""Independent numpy reference of the Iso-Dream++ equations; writes golden.json beside itself.

    python golden.py            write golden.json
    python golden.py --check    compute everything again and fail if golden.json differs

Needs numpy and the standard library only. Equation numbers are those of the paper: 3 transition priors, 4 inverse
dynamics, 5 composition, 6 L_base, 8 L_s, 9 L_z, 10 L_all, 11 gate, 12 sparse transition, 13 attention, 14 actor and value.
Where the paper and the authors' code disagree, every function says which of the two it follows.

File format: {key: {"doc": str, "inputs": {...}, "outputs": {...}}}.
* Tensors in `inputs` are exactly representable as f32. Plain numbers in `inputs` are hyper-parameters, written as
  decimals and meant as f64: 1 - f32(0.999) is off by 1.3e-5 relative, enough to fail a correct Adam.
* Weights have PyTorch's layout: Linear weight [out, in], y = x W^T + b.
* `outputs` are computed in f64 from those inputs and written with 12 significant digits, so that the file does not
  depend on the last bits of a machine's exp or matrix product.
* Each entry is computed a second time in f32; the script fails unless that agrees to F32_TOLERANCE of the largest
  magnitude in the tensor, i.e. unless an f32 implementation can pass a 1e-5 test. Compare the same way,
  |got - want| <= 1e-5 * max|want|: single elements can be small through cancellation.

Sizes: B=2 batch, T=3 chunk length, A=2 action, deter=4, stoch=3, hidden=5, embed=6.
Vocabulary: s = controllable branch, z = noncontrollable branch, b = background.
"""

import json
import math
import pathlib
import sys

import numpy as np

B, T, A = 2, 3, 2
DETER, STOCH, HIDDEN, EMBED = 4, 3, 5, 6
FEAT = STOCH + DETER
LOG_2PI = math.log(2.0 * math.pi)

F32_TOLERANCE = 2e-6
GOLDEN = pathlib.Path(__file__).resolve().parent / "golden.json"


# ---------------------------------------------------------------------------------------------------------------------
# Helpers. Every function below keeps the dtype of its arguments, so that it can run in f64 and in f32.
# ---------------------------------------------------------------------------------------------------------------------


def f32(x):
    """Rounds to f32 and returns f64: the only way tensors enter `inputs`."""
    return np.asarray(x, dtype=np.float32).astype(np.float64)


def linear_init(rng, out_features, in_features):
    """A Linear layer, U(-1/sqrt(in), 1/sqrt(in)) as in PyTorch -> weight [out, in], bias [out]."""
    bound = 1.0 / math.sqrt(in_features)
    return (
        f32(rng.uniform(-bound, bound, (out_features, in_features))),
        f32(rng.uniform(-bound, bound, out_features)),
    )


def linear(x, weight, bias):
    return x @ weight.T + bias


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def elu(x):
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def softmax(x):
    e = np.exp(x - x.max(axis=-1, keepdims=True))
    return e / e.sum(axis=-1, keepdims=True)


def cat(*parts):
    return np.concatenate(parts, axis=-1)


def normal_nll(x, mean):
    """-log Normal(x; mean, 1) per element, constant included."""
    return 0.5 * (x - mean) ** 2 + 0.5 * LOG_2PI


def finite_difference(f, x, step=1e-5):
    """Central differences of the scalar function f at x, element by element."""
    grad = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        up, down = x.copy(), x.copy()
        up[i] += step
        down[i] -= step
        grad[i] = (f(up) - f(down)) / (2 * step)
    return grad


def assert_close(name, got, want, tol=1e-7):
    got, want = np.asarray(got), np.asarray(want)
    assert got.shape == want.shape, f"{name}: shapes {got.shape} and {want.shape}"
    error = np.max(np.abs(got - want)) / max(1.0, np.max(np.abs(want)))
    assert error <= tol, f"{name}: off by {error:.3e} (allowed {tol:.0e})"


def assert_grads(name, loss, inputs, grads):
    """Checks analytic gradients {input name: gradient} of `loss(inputs)` against finite differences."""
    for key, grad in grads.items():
        fd = finite_difference(lambda x: loss({**inputs, key: x}), inputs[key])
        assert_close(f"{name}: gradient of {key}", fd, grad)


# ---------------------------------------------------------------------------------------------------------------------
# Networks
# ---------------------------------------------------------------------------------------------------------------------


def gru_cell(i):
    """LayerNorm GRU, the GRU_s / GRU_z of Eq. 3 (paper gives no formula; authors' code).

    p = LN(Linear([x, h])) jointly over all 3*deter features, biased variance, eps 1e-5; split in the order
    reset | candidate | update; the reset gate multiplies the candidate PRE-activation; the update bias is -1.
    """
    p = linear(cat(i["x"], i["h"]), i["weight"], i["bias"])
    mean = p.mean(axis=-1, keepdims=True)
    var = ((p - mean) ** 2).mean(axis=-1, keepdims=True)
    p = (p - mean) / np.sqrt(var + i["ln_eps"]) * i["ln_gamma"] + i["ln_beta"]
    reset, cand, update = np.split(p, 3, axis=-1)
    c = np.tanh(sigmoid(reset) * cand)
    u = sigmoid(update - 1.0)
    return {"h_next": u * c + (1.0 - u) * i["h"]}


def gru_weights(rng):
    """GRU weights with a LayerNorm away from its initial gamma=1, beta=0, so that a test sees both."""
    weight, bias = linear_init(rng, 3 * DETER, HIDDEN + DETER)
    return {
        "weight": weight,
        "bias": bias,
        "ln_gamma": f32(rng.uniform(0.5, 1.5, 3 * DETER)),
        "ln_beta": f32(rng.uniform(-0.5, 0.5, 3 * DETER)),
    }


def entry_gru_cell():
    rng = np.random.default_rng(101)
    inputs = {
        "x": f32(rng.standard_normal((B, HIDDEN))),
        "h": f32(rng.uniform(-1, 1, (B, DETER))),
        **gru_weights(rng),
        "ln_eps": 1e-5,
    }

    # The same cell written for single numbers.
    want = np.zeros((B, DETER))
    for b in range(B):
        xh = list(inputs["x"][b]) + list(inputs["h"][b])
        p = [sum(w * v for w, v in zip(row, xh)) + c for row, c in zip(inputs["weight"], inputs["bias"])]
        mu = sum(p) / len(p)
        sd = math.sqrt(sum((v - mu) ** 2 for v in p) / len(p) + 1e-5)
        p = [(v - mu) / sd * g + o for v, g, o in zip(p, inputs["ln_gamma"], inputs["ln_beta"])]
        for d in range(DETER):
            r = 1 / (1 + math.exp(-p[d]))
            c = math.tanh(r * p[DETER + d])
            u = 1 / (1 + math.exp(-(p[2 * DETER + d] - 1)))
            want[b, d] = u * c + (1 - u) * inputs["h"][b, d]
    assert_close("gru_cell: scalar version", gru_cell(inputs)["h_next"], want, 1e-14)

    doc = (
        "LayerNorm GRU (Eq. 3): p = LN(Linear([x, h])) over all 3*deter features; split reset|cand|update; "
        "h_next = u*c + (1-u)*h, c = tanh(sigmoid(reset)*cand), u = sigmoid(update - 1)."
    )
    return doc, inputs, gru_cell


def std_transform(raw):
    """std = 2 sigmoid(raw/2) + 0.1, used by prior, posterior and actor."""
    return 2.0 * sigmoid(raw / 2.0) + 0.1


def stats_head(x, hidden_w, hidden_b, out_w, out_b):
    """ELU(Linear) -> Linear -> mean | raw std -> mean, std."""
    out = linear(elu(linear(x, hidden_w, hidden_b)), out_w, out_b)
    mean, raw = np.split(out, 2, axis=-1)
    return mean, std_transform(raw)


def rssm_step(i):
    """One step of one branch: prior p(s~_t | h_t) of Eq. 3 and posterior q(s_t | h_t, o_t).

    Both branches share this form. The branch z of the authors' code also has action inputs: zeros on the real path, and
    +a, -a for the variance constraints (Eqs. 8, 9), where only the input layer and the GRU run again.
    """

    def transition(action):
        hidden = elu(linear(cat(i["stoch"], action), i["in_w"], i["in_b"]))
        gru = {key: i[f"gru_{key}"] for key in ("weight", "bias", "ln_gamma", "ln_beta", "ln_eps")}
        return hidden, gru_cell({"x": hidden, "h": i["deter"], **gru})["h_next"]

    hidden, deter = transition(i["action"])
    prior_mean, prior_std = stats_head(
        deter, i["prior_hidden_w"], i["prior_hidden_b"], i["prior_out_w"], i["prior_out_b"]
    )
    post_mean, post_std = stats_head(
        cat(deter, i["embed"]), i["post_hidden_w"], i["post_hidden_b"], i["post_out_w"], i["post_out_b"]
    )
    return {
        "hidden": hidden,
        "deter": deter,
        "deter_neg": transition(-i["action"])[1],
        "deter_zero": transition(np.zeros_like(i["action"]))[1],
        "prior_mean": prior_mean,
        "prior_std": prior_std,
        "prior_stoch": prior_mean + prior_std * i["eps_prior"],
        "post_mean": post_mean,
        "post_std": post_std,
        "post_stoch": post_mean + post_std * i["eps_post"],
    }


def entry_rssm_step():
    rng = np.random.default_rng(102)
    inputs = {
        "stoch": f32(rng.standard_normal((B, STOCH))),
        "deter": f32(rng.uniform(-1, 1, (B, DETER))),
        "action": f32(rng.uniform(-1, 1, (B, A))),
        "embed": f32(rng.standard_normal((B, EMBED))),
        "eps_prior": f32(rng.standard_normal((B, STOCH))),
        "eps_post": f32(rng.standard_normal((B, STOCH))),
    }
    inputs["in_w"], inputs["in_b"] = linear_init(rng, HIDDEN, STOCH + A)
    inputs.update({f"gru_{key}": value for key, value in gru_weights(rng).items()})
    inputs["gru_ln_eps"] = 1e-5
    inputs["prior_hidden_w"], inputs["prior_hidden_b"] = linear_init(rng, HIDDEN, DETER)
    inputs["prior_out_w"], inputs["prior_out_b"] = linear_init(rng, 2 * STOCH, HIDDEN)
    inputs["post_hidden_w"], inputs["post_hidden_b"] = linear_init(rng, HIDDEN, DETER + EMBED)
    inputs["post_out_w"], inputs["post_out_b"] = linear_init(rng, 2 * STOCH, HIDDEN)

    out = rssm_step(inputs)
    assert np.any(out["hidden"] < 0) and np.any(out["hidden"] > 0), "rssm_step: both sides of ELU must be seen"
    assert np.max(np.abs(out["deter"] - out["deter_neg"])) > 1e-3, "rssm_step: the action must matter"
    zero = rssm_step({**inputs, "eps_prior": 0 * inputs["eps_prior"]})
    assert_close("rssm_step: eps 0 gives the mean", zero["prior_stoch"], out["prior_mean"], 0)

    doc = (
        "One RSSM step of a branch (Eq. 3): hidden = ELU(in([stoch, action])); deter = GRU(hidden, deter); "
        "prior head on deter, posterior head on [deter, embed]; head = ELU(Linear) -> Linear -> mean | raw, "
        "std = 2*sigmoid(raw/2) + 0.1; stoch = mean + std*eps. deter_neg / deter_zero: same step with -action / 0."
    )
    return doc, inputs, rssm_step


def entry_std_transform():
    inputs = {"raw": f32([-8.0, -3.3, -1.0, -0.2, 0.0, 0.45, 1.0, 2.7, 8.0])}

    def compute(i):
        s = sigmoid(i["raw"] / 2.0)
        return {"std": std_transform(i["raw"]), "grad_raw": s * (1.0 - s)}

    out = compute(inputs)
    assert_grads(
        "std_transform", lambda i: compute(i)["std"].sum(), inputs, {"raw": out["grad_raw"]}
    )
    assert out["std"][4] == 1.1 and np.all((out["std"] > 0.1) & (out["std"] < 2.1))
    doc = "std = 2*sigmoid(raw/2) + 0.1 (range 0.1 to 2.1, 1.1 at raw = 0); grad_raw = d std / d raw."
    return doc, inputs, compute


# ---------------------------------------------------------------------------------------------------------------------
# World-model losses
# ---------------------------------------------------------------------------------------------------------------------


def diagonal_kl(post_mean, post_std, prior_mean, prior_std):
    """KL[q || p] of diagonal Gaussians, summed over the last axis (Eq. 6)."""
    per_dim = (
        np.log(prior_std / post_std)
        + (post_std**2 + (post_mean - prior_mean) ** 2) / (2.0 * prior_std**2)
        - 0.5
    )
    return per_dim.sum(axis=-1)


def kl(i):
    """KL of one branch in Eq. 6, with DreamerV2 balancing as in the authors' code (the paper has plain beta1 = beta2 = 1).

    balance * max(mean KL[sg(q) || p], free) + (1 - balance) * max(mean KL[q || sg(p)], free). The maximum is taken AFTER
    the mean over B and T, for each branch on its own. Forward both terms are equal; backward the first trains the
    prior only, the second the posterior only, and neither does while the mean is below `free`.
    """
    outputs = {}
    for case in ("above", "below"):
        c = i[case]
        q_mean, q_std, p_mean, p_std = c["post_mean"], c["post_std"], c["prior_mean"], c["prior_std"]
        mean_kl = diagonal_kl(q_mean, q_std, p_mean, p_std).mean()
        clipped = max(mean_kl, i["free"])
        active = 1.0 if mean_kl > i["free"] else 0.0
        count = q_mean.shape[0] * q_mean.shape[1]
        to_prior = active * i["balance"] / count
        to_post = active * (1.0 - i["balance"]) / count
        delta = q_mean - p_mean
        outputs[case] = {
            "mean_kl": mean_kl,
            "value": i["balance"] * clipped + (1.0 - i["balance"]) * clipped,
            "grad_post_mean": to_post * delta / p_std**2,
            "grad_post_std": to_post * (q_std / p_std**2 - 1.0 / q_std),
            "grad_prior_mean": to_prior * -delta / p_std**2,
            "grad_prior_std": to_prior * (1.0 / p_std - (q_std**2 + delta**2) / p_std**3),
        }
    return outputs


def entry_kl():
    rng = np.random.default_rng(103)
    shape = (B, T, STOCH)
    above = {
        "post_mean": f32(rng.standard_normal(shape)),
        "post_std": f32(rng.uniform(0.3, 1.5, shape)),
        "prior_mean": f32(rng.standard_normal(shape)),
        "prior_std": f32(rng.uniform(0.5, 1.8, shape)),
    }
    prior_mean, prior_std = rng.standard_normal(shape), rng.uniform(0.5, 1.8, shape)
    below = {
        "post_mean": f32(prior_mean + 0.3 * rng.standard_normal(shape)),
        "post_std": f32(prior_std * rng.uniform(0.7, 1.3, shape)),
        "prior_mean": f32(prior_mean),
        "prior_std": f32(prior_std),
    }
    # One step below `free` although the mean is above: there, clipping before the mean gives another value.
    above["prior_mean"][0, 0], above["prior_std"][0, 0] = above["post_mean"][0, 0], f32(above["post_std"][0, 0] * 1.2)
    inputs = {"balance": 0.8, "free": 1.0, "above": above, "below": below}
    out = kl(inputs)
    assert out["above"]["mean_kl"] > 1.2 and 0.05 < out["below"]["mean_kl"] < 0.8

    single = diagonal_kl(**above)
    assert single.min() < 0.9 and abs(np.maximum(single, 1.0).mean() - single.mean()) > 1e-3

    for case in ("above", "below"):
        c = inputs[case]
        # Stop-gradient for finite differences: the frozen side keeps its value while the other one moves.
        for side, weight in (("prior", 0.8), ("post", 0.2)):
            grads = {f"{side}_{k}": out[case][f"grad_{side}_{k}"] for k in ("mean", "std")}
            assert_grads(f"kl {case}", lambda x: weight * max(diagonal_kl(**x).mean(), 1.0), c, grads)
    assert all(np.all(v == 0) for k, v in out["below"].items() if k.startswith("grad_"))

    # One dimension against numerical integration of q log(q/p).
    x, w = np.polynomial.legendre.leggauss(400)
    qm, qs, pm, ps = 0.3, 0.7, -0.4, 1.2
    grid, weights = qm + 12 * qs * x, 12 * qs * w
    log_q = -0.5 * ((grid - qm) / qs) ** 2 - math.log(qs) - 0.5 * LOG_2PI
    log_p = -0.5 * ((grid - pm) / ps) ** 2 - math.log(ps) - 0.5 * LOG_2PI
    closed = diagonal_kl(*(np.array([v]) for v in (qm, qs, pm, ps)))
    assert_close("kl: integral", closed, (weights * np.exp(log_q) * (log_q - log_p)).sum(), 1e-10)

    doc = (
        "KL of one branch (Eq. 6), balance 0.8, free nats applied after the mean over [B, T]: value = "
        "0.8*max(mean KL[sg(post)||prior], free) + 0.2*max(mean KL[post||sg(prior)], free). Gradients are zero below free."
    )
    return doc, inputs, kl


def max_action(i):
    """Eq. 8 in the authors' bounded form: minimise mean_{B,T} |cos(h^s(a), h^s(-a))|, the cosine over deter.

    The paper maximises a sample variance instead, see `variance_paper`.
    """
    x, y = i["deter_pos"], i["deter_neg"]
    nx = np.sqrt((x * x).sum(axis=-1, keepdims=True))
    ny = np.sqrt((y * y).sum(axis=-1, keepdims=True))
    cos = (x * y).sum(axis=-1, keepdims=True) / (nx * ny)
    upstream = np.sign(cos) / cos.size
    return {
        "cos": cos[..., 0],
        "value": np.abs(cos).mean(),
        "grad_deter_pos": upstream * (y / (nx * ny) - cos * x / nx**2),
        "grad_deter_neg": upstream * (x / (nx * ny) - cos * y / ny**2),
    }


def entry_max_action():
    rng = np.random.default_rng(104)
    shape = (B, T, DETER)
    inputs = {"deter_pos": f32(rng.uniform(-1, 1, shape)), "deter_neg": f32(rng.uniform(-1, 1, shape))}
    out = max_action(inputs)
    assert out["cos"].min() < -0.05 and out["cos"].max() > 0.05, "max_action: both signs must be seen"
    assert np.abs(out["cos"]).min() > 1e-2, "max_action: stay away from the kink at 0"
    grads = {key: out[f"grad_{key}"] for key in inputs}
    assert_grads("max_action", lambda i: max_action(i)["value"], inputs, grads)
    same = max_action({"deter_pos": inputs["deter_pos"], "deter_neg": inputs["deter_pos"]})
    assert abs(same["value"] - 1) < 1e-12 and np.max(np.abs(same["grad_deter_pos"])) < 1e-12
    doc = "mean over [B, T] of |cos(h(a), h(-a))|, cosine over deter (authors' bounded form of Eq. 8), and its gradients."
    return doc, inputs, max_action


def min_free(i):
    """Eq. 9 in the authors' form: SUM (not mean) over B, T, deter of (h(0)-h(-a))^2 + (h(+a)-h(0))^2."""
    low, high = i["deter_zero"] - i["deter_neg"], i["deter_pos"] - i["deter_zero"]
    return {
        "value": (low**2 + high**2).sum(),
        "grad_deter_zero": 2.0 * (low - high),
        "grad_deter_neg": -2.0 * low,
        "grad_deter_pos": 2.0 * high,
    }


def entry_min_free():
    rng = np.random.default_rng(105)
    shape = (B, T, DETER)
    inputs = {key: f32(rng.uniform(-1, 1, shape)) for key in ("deter_zero", "deter_neg", "deter_pos")}
    out = min_free(inputs)
    assert_grads("min_free", lambda i: min_free(i)["value"], inputs, {k: out[f"grad_{k}"] for k in inputs})
    doc = "SUM over B, T, deter of (h(0)-h(-a))^2 + (h(+a)-h(0))^2 (authors' form of Eq. 9), and its gradients."
    return doc, inputs, min_free


def sample_variance(samples):
    """1/(n-1) sum_i (x_i - mean)^2 over axis 0 (n), summed over T and dims, mean over B; samples [n, B, T, stoch]."""
    n = samples.shape[0]
    centred = samples - samples.mean(axis=0, keepdims=True)
    return (centred**2).sum(axis=(0, 2, 3)).mean() / (n - 1)


def variance_paper(i):
    """The paper's own Eqs. 8 and 9: L_s = -Var over {a, -a} (maximised), L_z = Var over {a, 0, -a} (minimised)."""
    var_s, var_z = sample_variance(i["samples_s"]), sample_variance(i["samples_z"])
    return {"var_s": var_s, "var_z": var_z, "loss_s": -var_s, "loss_z": var_z}


def entry_variance_paper():
    rng = np.random.default_rng(106)
    inputs = {
        "samples_s": f32(rng.standard_normal((2, B, T, STOCH))),
        "samples_z": f32(rng.standard_normal((3, B, T, STOCH))),
    }
    out = variance_paper(inputs)
    for branch in "sz":
        want = np.var(inputs[f"samples_{branch}"], axis=0, ddof=1).sum(axis=(1, 2)).mean()
        assert_close("variance_paper", out[f"var_{branch}"], want, 1e-13)
    pos, neg = inputs["samples_s"]
    assert_close("variance_paper: n = 2", out["var_s"], 0.5 * ((pos - neg) ** 2).sum() / B, 1e-13)
    doc = (
        "Paper Eqs. 8 and 9 on prior samples [n, B, T, stoch]: n = 2 for s in the order {a, -a}, n = 3 for z in the order "
        "{a, 0, -a}; sample variance with n-1, summed over T and stoch, mean over B. loss_s = -var_s, loss_z = +var_z."
    )
    return doc, inputs, variance_paper


def gate(i):
    """Dependency gate (Eq. 11) and merged input of the noncontrollable transition (Eq. 12).

    From the authors' code: the gate reads the DETER vectors [h', h] (the paper: s~, z~); mean(w) is an extra loss; the
    merge layer z_in = Linear([z, w*s]) is applied whether the gate is open or not. In free-only rollouts the code skips the merge;
    we apply it with w = 0 (`z_in_closed`), so that training and rollout see the same input.

    Straight-through: forward w is 0 or 1, backward as if w = g = sigmoid(logit), dw/dlogit = g (1 - g).
    """
    stoch = i["stoch_s"].shape[-1]
    joined = cat(i["deter_z"], i["deter_s"])
    logit = linear(joined, i["gate_w"], i["gate_b"])
    g = sigmoid(logit)
    w = (g >= 0.5).astype(g.dtype)

    def merge(w):
        return linear(cat(i["stoch_z"], w * i["stoch_s"]), i["merge_w"], i["merge_b"])

    def backward(grad_w):
        grad_logit = grad_w * g * (1.0 - g)
        grad_z, grad_s = np.split(grad_logit @ i["gate_w"], 2, axis=-1)
        return {
            "gate_w": grad_logit.T @ joined,
            "gate_b": grad_logit.sum(axis=0),
            "deter_z": grad_z,
            "deter_s": grad_s,
        }

    # Upstream gradient on z_in, carried through the merge layer into w and both samples.
    through_s = i["grad_z_in"] @ i["merge_w"][:, stoch:]
    return {
        "logit": logit,
        "prob": g,
        "w": w,
        "penalty": w.mean(),
        "z_in": merge(w),
        "z_in_closed": merge(np.zeros_like(w)),
        "from_grad_w": backward(i["grad_w"]),
        "from_grad_z_in": {
            **backward((through_s * i["stoch_s"]).sum(axis=-1, keepdims=True)),
            "stoch_z": i["grad_z_in"] @ i["merge_w"][:, :stoch],
            "stoch_s": w * through_s,
        },
    }


def entry_gate():
    rng = np.random.default_rng(107)
    n = 4
    gate_w, _ = linear_init(rng, 1, 2 * DETER)
    inputs = {
        "deter_z": f32(rng.uniform(-1, 1, (n, DETER))),
        "deter_s": f32(rng.uniform(-1, 1, (n, DETER))),
        "stoch_z": f32(rng.standard_normal((n, STOCH))),
        "stoch_s": f32(rng.standard_normal((n, STOCH))),
        "gate_w": gate_w * 4,
        "gate_b": np.zeros(1),
        "grad_w": f32(rng.standard_normal((n, 1))),
        "grad_z_in": f32(rng.standard_normal((n, STOCH))),
    }
    inputs["merge_w"], inputs["merge_b"] = linear_init(rng, STOCH, 2 * STOCH)
    # Row 0 lies on the boundary: the initial state with bias 0 has sigmoid(0) = 0.5 exactly, which Eq. 11 calls open.
    inputs["deter_z"][0] = inputs["deter_s"][0] = 0.0

    out = gate(inputs)
    assert out["w"][0, 0] == 1 and 0 < out["w"][1:].sum() < n - 1, f"gate: both states must be seen: {out['logit'].ravel()}"
    assert np.abs(out["logit"][1:]).min() > 0.1, "gate: stay away from the threshold"

    # The straight-through estimator is the gradient of w = (w0 - g0) + g with the bracket held constant.
    offset = out["w"] - out["prob"]

    def surrogate(i):
        return offset + sigmoid(linear(cat(i["deter_z"], i["deter_s"]), i["gate_w"], i["gate_b"]))

    def loss_w(i):
        return (surrogate(i) * i["grad_w"]).sum()

    def loss_z_in(i):
        z_in = linear(cat(i["stoch_z"], surrogate(i) * i["stoch_s"]), i["merge_w"], i["merge_b"])
        return (z_in * i["grad_z_in"]).sum()

    assert_grads("gate", loss_w, inputs, out["from_grad_w"])
    assert_grads("gate and merge", loss_z_in, inputs, out["from_grad_z_in"])

    doc = (
        "Gate (Eq. 11): logit = Linear([deter_z, deter_s]), prob = sigmoid, w = 1[prob >= 0.5] (row 0 is exactly 0.5, "
        "open); penalty = mean(w). Merge (Eq. 12): z_in = Linear([stoch_z, w*stoch_s]); z_in_closed: same with w = 0. "
        "from_grad_w: straight-through gradients of sum(w*grad_w); from_grad_z_in: of sum(z_in*grad_z_in)."
    )
    return doc, inputs, gate


def composition(i):
    """Eq. 5: o_hat = M_s rgb_s + M_z rgb_z + (1 - M_s - M_z) background, and the image term of Eq. 6.

    The masks are independent sigmoids (authors' code), so M_b may be negative. RGB and background are clamped to
    [-0.5, 0.5], with zero gradient outside. One background per chunk, broadcast over time.
    """
    rgb_s, rgb_z = (np.clip(i[k], -0.5, 0.5) for k in ("rgb_s", "rgb_z"))
    background = np.clip(i["background"], -0.5, 0.5)[:, None]
    mask_s, mask_z = sigmoid(i["mask_logit_s"]), sigmoid(i["mask_logit_z"])
    mask_b = 1.0 - mask_s - mask_z
    o_hat = mask_s * rgb_s + mask_z * rgb_z + mask_b * background
    log_prob = -normal_nll(i["obs"], o_hat).sum(axis=(2, 3, 4))

    inside = {k: (np.abs(i[k]) < 0.5).astype(o_hat.dtype) for k in ("rgb_s", "rgb_z", "background")}
    d = (o_hat - i["obs"]) / log_prob.size
    return {
        "mask_s": mask_s,
        "mask_z": mask_z,
        "mask_b": mask_b,
        "o_hat": o_hat,
        "log_prob": log_prob,
        "image_loss": -log_prob.mean(),
        "grad_rgb_s": d * mask_s * inside["rgb_s"],
        "grad_rgb_z": d * mask_z * inside["rgb_z"],
        "grad_mask_logit_s": (d * (rgb_s - background)).sum(axis=2, keepdims=True) * mask_s * (1.0 - mask_s),
        "grad_mask_logit_z": (d * (rgb_z - background)).sum(axis=2, keepdims=True) * mask_z * (1.0 - mask_z),
        "grad_background": (d * mask_b).sum(axis=1) * inside["background"],
    }


def entry_composition():
    rng = np.random.default_rng(108)
    height = width = 2
    rgb, mask = (B, T, 3, height, width), (B, T, 1, height, width)
    inputs = {
        "rgb_s": f32(rng.uniform(-0.8, 0.8, rgb)),
        "mask_logit_s": f32(1.5 * rng.standard_normal(mask)),
        "rgb_z": f32(rng.uniform(-0.8, 0.8, rgb)),
        "mask_logit_z": f32(1.5 * rng.standard_normal(mask)),
        "background": f32(rng.uniform(-0.8, 0.8, (B, 3, height, width))),
        "obs": f32(rng.integers(0, 256, rgb) / 255.0 - 0.5),
    }
    out = composition(inputs)
    for key in ("rgb_s", "rgb_z", "background"):
        assert np.abs(inputs[key]).max() > 0.5, "composition: the clamp must act"
        assert np.abs(np.abs(inputs[key]) - 0.5).min() > 1e-4, "composition: stay away from the clamp's kink"
    assert out["mask_b"].min() < 0 < out["mask_b"].max()
    grads = {key: out[f"grad_{key}"] for key in inputs if key != "obs"}
    assert_grads("composition", lambda i: composition(i)["image_loss"], inputs, grads)
    doc = (
        "Eq. 5 with rgb_s, rgb_z, background given UNCLAMPED (clamp to [-0.5, 0.5] inside) and independent sigmoid masks; "
        "log_prob [B, T] of Normal(o_hat, 1), summed over pixels with the constant; image_loss = -mean_{B,T} log_prob "
        "(Eq. 6) and its gradients. background [B, 3, H, W] is broadcast over T."
    )
    return doc, inputs, composition


def inverse_loss(i):
    """Action term of Eq. 6 on the inverse dynamics of Eq. 4: Gaussian NLL (authors' code; the paper has plain l2).

    -mean_{B, T-1} sum_A log Normal(a; a_hat, 1). Step t = 1..T-1 compares the action that led from t-1 to t.
    """
    error = i["action_pred"] - i["action"]
    count = error.shape[0] * error.shape[1]
    return {
        "value": normal_nll(i["action"], i["action_pred"]).sum(axis=-1).mean(),
        "grad_action_pred": error / count,
    }


def entry_inverse_loss():
    rng = np.random.default_rng(109)
    shape = (B, T - 1, A)
    inputs = {"action": f32(rng.uniform(-1, 1, shape)), "action_pred": f32(rng.uniform(-1, 1, shape))}
    out = inverse_loss(inputs)
    grads = {"action_pred": out["grad_action_pred"]}
    assert_grads("inverse_loss", lambda i: inverse_loss(i)["value"], inputs, grads)
    want = 0.5 * ((inputs["action"] - inputs["action_pred"]) ** 2).sum() / (B * (T - 1)) + 0.5 * A * LOG_2PI
    assert_close("inverse_loss", out["value"], want, 1e-13)
    doc = (
        "Eqs. 4 and 6: mean over [B, T-1] of 0.5*||a - a_hat||^2 + A/2*log(2 pi); both tensors are [B, T-1, A], rows "
        "t = 1..T-1 of the chunk (a row holds the action that led to its observation)."
    )
    return doc, inputs, inverse_loss


def reward_loss(i):
    """Reward term of Eq. 6 with the authors' scale 2 (paper: 1): scale * mean_{B,T} -log Normal(r; r_hat, 1)."""
    return {
        "value": i["scale"] * normal_nll(i["reward"], i["reward_pred"]).mean(),
        "grad_reward_pred": i["scale"] * (i["reward_pred"] - i["reward"]) / i["reward"].size,
    }


def entry_reward_loss():
    rng = np.random.default_rng(110)
    inputs = {
        "reward": f32(rng.standard_normal((B, T))),
        "reward_pred": f32(rng.standard_normal((B, T))),
        "scale": 2.0,
    }
    out = reward_loss(inputs)
    grads = {"reward_pred": out["grad_reward_pred"]}
    assert_grads("reward_loss", lambda i: reward_loss(i)["value"], inputs, grads)
    doc = "Eq. 6 reward term: 2 * mean over [B, T] of -log Normal(reward; reward_pred, 1), constant included (and scaled)."
    return doc, inputs, reward_loss


# ---------------------------------------------------------------------------------------------------------------------
# Behaviour learning
# ---------------------------------------------------------------------------------------------------------------------


def attention(i):
    """Eq. 13 with the learned projections of the authors' code (the paper has none).

    q = Wq query; k, v = Wk memory, Wv memory; weights = softmax(q k^T / sqrt(proj)); e = Wo(weights v) + query.
    """
    q = linear(i["query"], i["wq"], i["bq"])
    k = linear(i["memory"], i["wk"], i["bk"])
    v = linear(i["memory"], i["wv"], i["bv"])
    weights = softmax((q[:, None, :] * k).sum(axis=-1) / math.sqrt(q.shape[-1]))
    pooled = (weights[:, :, None] * v).sum(axis=1)
    return {"weights": weights, "e": linear(pooled, i["wo"], i["bo"]) + i["query"]}


def entry_attention():
    rng = np.random.default_rng(111)
    tau, proj = 5, 2 * FEAT
    inputs = {
        "query": f32(2 * rng.standard_normal((B, FEAT))),
        "memory": f32(2 * rng.standard_normal((B, tau, FEAT))),
    }
    for name, out_features, in_features in (
        ("q", proj, FEAT),
        ("k", proj, FEAT),
        ("v", proj, FEAT),
        ("o", FEAT, proj),
    ):
        inputs[f"w{name}"], inputs[f"b{name}"] = linear_init(rng, out_features, in_features)

    out = attention(inputs)
    assert_close("attention: weights sum to 1", out["weights"].sum(axis=1), np.ones(B), 1e-14)
    assert np.ptp(out["weights"], axis=1).min() > 0.05, "attention: the weights must differ"
    for b in range(B):
        q = inputs["wq"] @ inputs["query"][b] + inputs["bq"]
        scores = [math.exp(q @ (inputs["wk"] @ m + inputs["bk"]) / math.sqrt(proj)) for m in inputs["memory"][b]]
        mix = sum(s / sum(scores) * (inputs["wv"] @ m + inputs["bv"]) for s, m in zip(scores, inputs["memory"][b]))
        want = inputs["wo"] @ mix + inputs["bo"] + inputs["query"][b]
        assert_close("attention: loop version", out["e"][b], want, 1e-13)
    # The order of the memory does not matter to e.
    shuffled = attention({**inputs, "memory": inputs["memory"][:, ::-1]})
    assert_close("attention: permutation", shuffled["e"], out["e"], 1e-13)

    doc = (
        "Eq. 13, authors' form, single head: weights [B, tau] = softmax(q.k / sqrt(proj)), e [B, F] = Wo(weights v) + bo "
        "+ query. F = stoch + deter = 7, proj = 14, tau = 5; weights wq, wk, wv [proj, F], wo [F, proj]."
    )
    return doc, inputs, attention


def lambda_return(rewards, values, discounts, lam):
    """TD(lambda) return (target of Eq. 14's value model, DreamerV2), state-aligned, all arguments [H, ...].

    G_{H-1} = v_{H-1};  G_t = r_t + d_t ((1 - lambda) v_{t+1} + lambda G_{t+1}). Not time-reversed: index t holds G_t (the
    authors' code returns them reversed, a bug).
    """
    returns = [values[-1]]
    for t in reversed(range(len(rewards) - 1)):
        returns.append(rewards[t] + discounts[t] * ((1.0 - lam) * values[t + 1] + lam * returns[-1]))
    return np.stack(returns[::-1])


def return_weights(discounts):
    """w_t = d_0 d_1 .. d_{t-1}, w_0 = 1."""
    return np.cumprod(np.concatenate([np.ones_like(discounts[:1]), discounts[:-1]]), axis=0)


def entry_lambda_return():
    rng = np.random.default_rng(112)
    horizon = 5
    discounts = rng.uniform(0.6, 1.0, horizon)
    discounts[2] = 0.0  # a predicted end of the episode: nothing after t = 2 may reach G_0..G_2
    inputs = {
        "rewards": f32(rng.standard_normal(horizon)),
        "values": f32(rng.standard_normal(horizon)),
        "discount": 0.99,
        "discounts": f32(discounts),
        "lambda": 0.95,
    }

    def compute(i):
        r, v, lam = i["rewards"], i["values"], i["lambda"]
        constant = np.full_like(r, i["discount"])
        return {
            "scalar": {"returns": lambda_return(r, v, constant, lam), "weights": return_weights(constant)},
            "per_step": {
                "returns": lambda_return(r, v, i["discounts"], lam),
                "weights": return_weights(i["discounts"]),
            },
        }

    # The recursion equals the exponentially weighted mixture of n-step returns.
    out = compute(inputs)
    r, v, lam = inputs["rewards"], inputs["values"], inputs["lambda"]
    for case, d in (("scalar", np.full(horizon, 0.99)), ("per_step", inputs["discounts"])):
        for t in range(horizon - 1):

            def n_step(n):
                reward = sum(np.prod(d[t : t + k]) * r[t + k] for k in range(n))
                return reward + np.prod(d[t : t + n]) * v[t + n]

            steps = horizon - 1 - t
            want = sum((1 - lam) * lam ** (n - 1) * n_step(n) for n in range(1, steps))
            want += lam ** (steps - 1) * n_step(steps)
            assert_close(f"lambda_return {case} t={t}", out[case]["returns"][t], want, 1e-13)
        assert out[case]["returns"][-1] == v[-1]
        assert_close("weights", out[case]["weights"], [np.prod(d[:t]) for t in range(horizon)], 1e-13)
    # Neither the last reward nor the last discount is used.
    changed = {**inputs, "rewards": r + np.eye(horizon)[-1], "discounts": inputs["discounts"] + np.eye(horizon)[-1]}
    for case in ("scalar", "per_step"):
        for key in ("returns", "weights"):
            assert np.array_equal(compute(changed)[case][key], out[case][key])

    doc = (
        "rewards, values, discounts are [H], H = 5, aligned with states x_0..x_{H-1}. Discount indexing: discounts[t] = d_t "
        "multiplies the continuation FROM t TO t+1: G_t = r_t + d_t*((1-lambda)*v_{t+1} + lambda*G_{t+1}), t = 0..H-2, "
        "G_{H-1} = v_{H-1}. weights[t] = d_0*..*d_{t-1}, weights[0] = 1. d_{H-1} and r_{H-1} are unused. "
        "scalar: d_t = discount for all t; per_step: d_t = discounts[t] (d_2 = 0)."
    )
    return doc, inputs, compute


# Truncated normal. numpy has no error function: math's works on f64, and results return to the argument's dtype.


def erfc(x):
    return np.vectorize(math.erfc, otypes=[np.float64])(x).astype(x.dtype)


def normal_pdf(x):
    return np.exp(-0.5 * x**2) / math.sqrt(2.0 * math.pi)


def normal_cdf(x):
    return 0.5 * erfc(-x / math.sqrt(2.0))


def normal_icdf(p):
    """Inverse of normal_cdf by bisection in f64."""
    target = p.astype(np.float64)
    low, high = np.full_like(target, -40.0), np.full_like(target, 40.0)
    for _ in range(100):
        mid = 0.5 * (low + high)
        below = normal_cdf(mid) < target
        low, high = np.where(below, mid, low), np.where(below, high, mid)
    return (0.5 * (low + high)).astype(p.dtype)


def truncated_normal(i):
    """Actor distribution of Eq. 14: Normal(mean, std) restricted to [-1, 1] and renormalised.

    A real truncated normal as in DreamerV2; the authors' class never truncates (a bug). mean and std are those of the parent.
    With alpha, beta = (low - mean)/std, (high - mean)/std, Z = Phi(beta) - Phi(alpha), xi = (x - mean)/std:
      sample    x = mean + std Phi^-1(Phi(alpha) + u Z), u in (0, 1)
      log p     = -xi^2/2 - log(std sqrt(2 pi)) - log Z
      entropy   = log(sqrt(2 pi e) std Z) + (alpha phi(alpha) - beta phi(beta)) / (2 Z)
      dx/dmean  = 1 - ((1-u) phi(alpha) + u phi(beta)) / phi(xi)          for fixed u
      dx/dstd   = xi - ((1-u) alpha phi(alpha) + u beta phi(beta)) / phi(xi)
    """
    mean, std = i["mean"], i["std"]
    alpha, beta = (i["low"] - mean) / std, (i["high"] - mean) / std
    cdf_alpha = normal_cdf(alpha)
    z = normal_cdf(beta) - cdf_alpha
    pdf_a, pdf_b = normal_pdf(alpha), normal_pdf(beta)

    u = i["u"]
    xi = normal_icdf(cdf_alpha[:, None] + u * z[:, None])
    pdf_xi = normal_pdf(xi)
    tilt_mean = (1.0 - u) * pdf_a[:, None] + u * pdf_b[:, None]
    tilt_std = (1.0 - u) * (alpha * pdf_a)[:, None] + u * (beta * pdf_b)[:, None]

    # With da/dmean = db/dmean = -1/std, da/dstd = -alpha/std, db/dstd = -beta/std and d(x phi(x))/dx = phi(x)(1 - x^2).
    q = alpha * pdf_a - beta * pdf_b
    da_mean, db_mean = -1.0 / std, -1.0 / std
    da_std, db_std = -alpha / std, -beta / std

    def entropy_grad(da, db):
        dz = pdf_b * db - pdf_a * da
        dq = pdf_a * (1.0 - alpha**2) * da - pdf_b * (1.0 - beta**2) * db
        return dz / z + dq / (2.0 * z) - q * dz / (2.0 * z**2)

    return {
        "sample": mean[:, None] + std[:, None] * xi,
        "dsample_dmean": 1.0 - tilt_mean / pdf_xi,
        "dsample_dstd": xi - tilt_std / pdf_xi,
        "log_prob": (
            -0.5 * ((i["x"] - mean[:, None]) / std[:, None]) ** 2
            - np.log(std)[:, None]
            - 0.5 * LOG_2PI
            - np.log(z)[:, None]
        ),
        "entropy": 0.5 * (LOG_2PI + 1.0) + np.log(std) + np.log(z) + q / (2.0 * z),
        "dentropy_dmean": entropy_grad(da_mean, db_mean),
        "dentropy_dstd": 1.0 / std + entropy_grad(da_std, db_std),
    }


def entry_truncated_normal():
    rng = np.random.default_rng(113)
    mean = f32([-0.9, -0.3, 0.0, 0.25, 0.6, 0.95])
    std = f32([0.15, 1.1, 2.09, 0.11, 0.5, 0.3])
    inputs = {
        "mean": mean,
        "std": std,
        "low": -1.0,
        "high": 1.0,
        "u": f32(np.concatenate([np.tile([0.02, 0.5, 0.98], (6, 1)), rng.uniform(0.05, 0.95, (6, 2))], axis=1)),
        "x": f32(np.concatenate([np.tile([-0.95, 0.0, 0.95], (6, 1)), rng.uniform(-1, 1, (6, 1))], axis=1)),
    }
    out = truncated_normal(inputs)
    assert np.all(np.abs(out["sample"]) < 1)

    # Normalisation and entropy by Gauss-Legendre quadrature over [-1, 1].
    x, w = np.polynomial.legendre.leggauss(400)
    density = truncated_normal({**inputs, "x": np.tile(x, (6, 1))})["log_prob"]
    assert_close("truncated_normal: density integrates to 1", np.exp(density) @ w, np.ones(6), 1e-11)
    assert_close("truncated_normal: entropy", -(np.exp(density) * density) @ w, out["entropy"], 1e-10)

    # u is the distribution function at the sample, again by quadrature.
    for k in range(6):
        for j, s in enumerate(out["sample"][k]):
            half = 0.5 * (s + 1.0)
            grid = -1.0 + half * (x + 1.0)
            p = truncated_normal({**inputs, "x": np.tile(grid, (6, 1))})["log_prob"][k]
            assert_close("truncated_normal: sample", half * np.exp(p) @ w, inputs["u"][k, j], 1e-10)

    # Derivatives; each row depends on its own mean and std only.
    step = 1e-5
    for key in ("mean", "std"):
        up, down = (truncated_normal({**inputs, key: inputs[key] + h}) for h in (step, -step))
        for value in ("sample", "entropy"):
            fd = (up[value] - down[value]) / (2 * step)
            assert_close(f"truncated_normal: d{value}/d{key}", fd, out[f"d{value}_d{key}"], 1e-6)

    doc = (
        "Normal(mean, std) truncated to [low, high] = [-1, 1]; mean, std [6] are the parent's. sample [6, 5] = inverse CDF at "
        "u, with derivatives at fixed u; log_prob [6, 4] at x; entropy [6] with derivatives. No clip to +-(1 - 1e-6)."
    )
    return doc, inputs, truncated_normal


def entry_actor_loss():
    rng = np.random.default_rng(114)
    horizon, n = 5, 2
    inputs = {
        "returns": f32(rng.standard_normal((horizon, n))),
        "entropies": f32(rng.uniform(-2.0, 1.5, (horizon, n))),
        "weights": f32(np.cumprod(np.concatenate([np.ones((1, n)), rng.uniform(0.6, 1.0, (horizon - 1, n))]), axis=0)),
        "entropy_scale": 1e-4,
        "entropy_scale_large": 0.5,
    }

    def compute(i):
        """Actor loss (Eq. 14, 'dynamics' gradient): -mean_{t=0..H-2, N} w_t (G_t + scale * entropy_t), w detached."""
        w = i["weights"][:-1]

        def case(scale):
            grad = np.concatenate([-w / w.size, np.zeros_like(w[:1])])
            return {
                "loss": -(w * (i["returns"][:-1] + scale * i["entropies"][:-1])).mean(),
                "grad_returns": grad,
                "grad_entropies": scale * grad,
            }

        return {"standard": case(i["entropy_scale"]), "large": case(i["entropy_scale_large"])}

    out = compute(inputs)
    for name in ("standard", "large"):
        grads = {k: out[name][f"grad_{k}"] for k in ("returns", "entropies")}
        assert_grads(f"actor_loss {name}", lambda i: compute(i)[name]["loss"], inputs, grads)
    doc = (
        "-mean over t = 0..H-2 and N of weights*(returns + scale*entropies); all tensors [H, N] time-major with H = 5, the "
        "last row (t = H-1) unused, weights detached. standard: scale 1e-4; large: scale 0.5, because at 1e-4 a wrong entropy "
        "term hides below the tolerance."
    )
    return doc, inputs, compute


def entry_critic_loss():
    rng = np.random.default_rng(115)
    horizon, n = 5, 2
    inputs = {
        "values": f32(rng.standard_normal((horizon, n))),
        "returns": f32(rng.standard_normal((horizon, n))),
        "weights": f32(np.cumprod(np.concatenate([np.ones((1, n)), rng.uniform(0.6, 1.0, (horizon - 1, n))]), axis=0)),
    }

    def compute(i):
        """Value loss (Eq. 14): mean_{t=0..H-2, N} w_t * -log Normal(sg(G_t); v_t, 1). The constant is weighted too."""
        v, g, w = (i[k][:-1] for k in ("values", "returns", "weights"))
        return {
            "loss": (w * normal_nll(g, v)).mean(),
            "loss_without_constant": (w * 0.5 * (v - g) ** 2).mean(),
            "grad_values": np.concatenate([w * (v - g) / w.size, np.zeros_like(w[:1])]),
        }

    out = compute(inputs)
    assert_grads("critic_loss", lambda i: compute(i)["loss"], inputs, {"values": out["grad_values"]})
    doc = (
        "mean over t = 0..H-2 and N of weights*(0.5*(values - sg(returns))^2 + 0.5*log(2 pi)); tensors [H, N] time-major "
        "with H = 5, the last row unused. The constant is inside the weighting; loss_without_constant leaves it out."
    )
    return doc, inputs, compute


# ---------------------------------------------------------------------------------------------------------------------
# Optimiser
# ---------------------------------------------------------------------------------------------------------------------


def adam(i):
    """Adam with bias correction and global-norm clipping, in PyTorch's conventions.

    coef = min(1, clip / (norm + 1e-6)) over all parameters together; theta -= lr * m_hat / (sqrt(v_hat) + eps), with
    m_hat = m / (1 - b1^t), v_hat = v / (1 - b2^t), t = 1, 2, ...; no weight decay.
    """
    names = ("p0", "p1")
    params = {k: i["params"][k] for k in names}
    m = {k: np.zeros_like(v) for k, v in params.items()}
    v = {k: np.zeros_like(p) for k, p in params.items()}
    steps = []
    for t, grads in enumerate(i["grads"], start=1):
        norm = np.sqrt(sum((grads[k] ** 2).sum() for k in names))
        coef = min(1.0, i["clip"] / (norm + 1e-6))
        for k in names:
            g = coef * grads[k]
            m[k] = i["beta1"] * m[k] + (1.0 - i["beta1"]) * g
            v[k] = i["beta2"] * v[k] + (1.0 - i["beta2"]) * g**2
            m_hat = m[k] / (1.0 - i["beta1"] ** t)
            v_hat = v[k] / (1.0 - i["beta2"] ** t)
            params[k] = params[k] - i["lr"] * m_hat / (np.sqrt(v_hat) + i["eps"])
        steps.append({"grad_norm": norm, "params": dict(params), "exp_avg": dict(m), "exp_avg_sq": dict(v)})
    return {"steps": steps}


def entry_adam():
    rng = np.random.default_rng(116)
    # Parameters of the size of an update (1e-3), so that a relative tolerance on them sees the updates; gradients of p1 near
    # eps, so that the place of eps matters.
    inputs = {
        "params": {"p0": f32(1e-3 * rng.standard_normal((3, 2))), "p1": f32(1e-3 * rng.standard_normal(4))},
        "grads": [
            {"p0": f32(scale * rng.standard_normal((3, 2))), "p1": f32(1e-5 * rng.standard_normal(4))}
            for scale in (1.0, 200.0, 2.0)
        ],
        "lr": 3e-4,
        "beta1": 0.9,
        "beta2": 0.999,
        "eps": 1e-5,
        "clip": 100.0,
    }
    out = adam(inputs)
    norms = [s["grad_norm"] for s in out["steps"]]
    assert norms[0] < 90 and norms[1] > 150 and norms[2] < 90, norms

    # First step in closed form: theta - lr * g / (|g| + eps), whatever the betas are.
    for k in ("p0", "p1"):
        g = inputs["grads"][0][k]
        want = inputs["params"][k] - 3e-4 * g / (np.abs(g) + 1e-5)
        assert_close("adam: first step", out["steps"][0]["params"][k] * 1e3, want * 1e3, 1e-12)
    # Third step from the sums: m_3 = (1-b1) sum b1^(3-t) g_t, v_3 likewise, g_2 scaled to norm 100.
    scales = [1.0, 100.0 / (norms[1] + 1e-6), 1.0]
    for k in ("p0", "p1"):
        g = [c * step[k] for c, step in zip(scales, inputs["grads"])]
        m3 = 0.1 * sum(0.9 ** (2 - t) * g[t] for t in range(3)) / (1 - 0.9**3)
        v3 = 0.001 * sum(0.999 ** (2 - t) * g[t] ** 2 for t in range(3)) / (1 - 0.999**3)
        want = out["steps"][1]["params"][k] - 3e-4 * m3 / (np.sqrt(v3) + 1e-5)
        assert_close("adam: third step", out["steps"][2]["params"][k] * 1e3, want * 1e3, 1e-11)

    doc = (
        "Three Adam steps after global-norm clipping at 100 (coef = min(1, clip/(norm + 1e-6)) over p0 and p1 together; step "
        "2 is clipped). grad_norm is the norm BEFORE clipping; steps[t] holds params, exp_avg, exp_avg_sq after step t+1."
    )
    return doc, inputs, adam


# ---------------------------------------------------------------------------------------------------------------------
# Driver
# ---------------------------------------------------------------------------------------------------------------------

ENTRIES = {
    "gru_cell": entry_gru_cell,
    "rssm_step": entry_rssm_step,
    "kl": entry_kl,
    "max_action": entry_max_action,
    "min_free": entry_min_free,
    "variance_paper": entry_variance_paper,
    "gate": entry_gate,
    "composition": entry_composition,
    "inverse_loss": entry_inverse_loss,
    "reward_loss": entry_reward_loss,
    "attention": entry_attention,
    "lambda_return": entry_lambda_return,
    "truncated_normal": entry_truncated_normal,
    "adam": entry_adam,
    "std_transform": entry_std_transform,
    "actor_loss": entry_actor_loss,
    "critic_loss": entry_critic_loss,
}


def leaves(tree, path=""):
    """(path, value) of every array or number in nested dicts and lists."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaves(value, f"{path}.{key}" if path else key)
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            yield from leaves(value, f"{path}[{index}]")
    else:
        yield path, tree


def map_arrays(tree, f):
    if isinstance(tree, dict):
        return {key: map_arrays(value, f) for key, value in tree.items()}
    if isinstance(tree, list):
        return [map_arrays(value, f) for value in tree]
    return f(tree) if isinstance(tree, np.ndarray) else tree


def check_f32(name, inputs, compute, outputs):
    """Fails unless the same formulas in f32 reach the f64 values; returns the worst error and its place."""
    for path, value in leaves(inputs):
        if isinstance(value, np.ndarray):
            assert np.array_equal(f32(value), value), f"{name}.{path} is not representable as f32"
    single = dict(leaves(compute(map_arrays(inputs, lambda x: x.astype(np.float32)))))
    worst = (0.0, "")
    for path, want in leaves(outputs):
        got = np.asarray(single[path])
        assert np.all(np.isfinite(want)), f"{name}.{path} is not finite"
        assert not isinstance(want, np.ndarray) or got.dtype == np.float32, f"{name}.{path}: f32 run left f32"
        scale = np.max(np.abs(want))
        error = np.max(np.abs(got - want)) / scale if scale > 0 else np.max(np.abs(got))
        worst = max(worst, (float(error), path))
    assert worst[0] <= F32_TOLERANCE, f"{name}: f32 differs by {worst}"
    return worst


def shapes(tree):
    return ", ".join(
        f"{path}{list(value.shape)}" if isinstance(value, np.ndarray) else f"{path}" for path, value in leaves(tree)
    )


def dump(tree, convert, indent):
    """JSON with one tensor per line."""
    pad = " " * (indent + 1)
    if isinstance(tree, dict):
        rows = [f"{pad}{json.dumps(k)}: {dump(v, convert, indent + 1)}" for k, v in tree.items()]
        return "{\n" + ",\n".join(rows) + "\n" + " " * indent + "}"
    if isinstance(tree, list):
        return "[\n" + ",\n".join(pad + dump(v, convert, indent + 1) for v in tree) + "\n" + " " * indent + "]"
    if isinstance(tree, str):
        return json.dumps(tree)

    def nested(x):
        # `+ 0.0` turns -0.0 into 0.0.
        return [nested(v) for v in x] if isinstance(x, list) else convert(x) + 0.0

    return json.dumps(nested(np.asarray(tree, dtype=np.float64).tolist()), allow_nan=False)


def main():
    rows = []
    for name, entry in ENTRIES.items():
        doc, inputs, compute = entry()
        outputs = compute(inputs)
        error, place = check_f32(name, inputs, compute, outputs)
        print(f"{name}: f32 error {error:.1e} ({place})\n  in:  {shapes(inputs)}\n  out: {shapes(outputs)}")
        rows.append(
            f" {json.dumps(name)}: {{\n"
            f"  \"doc\": {json.dumps(doc)},\n"
            f"  \"inputs\": {dump(inputs, float, 2)},\n"
            f"  \"outputs\": {dump(outputs, lambda x: float(f'{x:.12g}'), 2)}\n"
            " }"
        )
    text = "{\n" + ",\n".join(rows) + "\n}\n"
    assert set(json.loads(text)) == set(ENTRIES)
    if "--check" in sys.argv[1:]:
        if not GOLDEN.exists() or GOLDEN.read_text() != text:
            sys.exit(f"{GOLDEN} is not what this script computes; run it without --check")
        print(f"{GOLDEN} is up to date")
    else:
        GOLDEN.write_text(text)
        print(f"wrote {GOLDEN} ({len(text)} bytes)")


if __name__ == "__main__":
    main()
