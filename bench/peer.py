"""One training step of Iso-Dream++ in plain PyTorch: what `isodream bench learner` is compared with.

The same networks, losses and sizes as the paper's driving setup, written the way one writes PyTorch first: nothing
is hoisted out of a scan, nothing is fused, every branch runs by itself, the decoders go frame by frame. With
`--as-published` it also does the work of the published code that nobody uses: hypothetical transitions while imagining,
a rollout step that no memory holds, and every policy worked out twice more, once for its loss and once for nothing.

    python bench/peer.py --batch 16 --length 32 --steps 3 --threads 2

Prints JSON: wall and CPU seconds per step (the fastest of them), by phase, and the peak memory.
"""

import argparse
import json
import resource
import time

import torch
import torch.nn.functional as F
from torch import nn

ACTIONS, DEPTH, DETER, STOCH, HIDDEN, UNITS, DIM = 2, 32, 200, 50, 200, 400, 500
FEAT, EMBED, BACKGROUND = DETER + STOCH, 8 * DEPTH * 4, 10
HORIZON, WINDOW, DISCOUNT, LAMBDA, ENTROPY = 15, 5, 0.99, 0.95, 1e-4


def mlp(inputs, layers, outputs):
    parts = []
    for _ in range(layers):
        parts += [nn.Linear(inputs, UNITS), nn.ELU()]
        inputs = UNITS
    return nn.Sequential(*parts, nn.Linear(inputs, outputs))


class Encoder(nn.Module):
    def __init__(self):
        super().__init__()
        conv = lambda a, b: nn.Sequential(nn.Conv2d(a, b, 4, 2), nn.ELU())
        self.stem = nn.Sequential(conv(3, DEPTH), conv(DEPTH, 2 * DEPTH))
        tail = lambda planes: nn.Sequential(conv(2 * DEPTH + planes, 4 * DEPTH), conv(4 * DEPTH, 8 * DEPTH))
        self.s, self.z, self.background = tail(ACTIONS), tail(ACTIONS), tail(0)

    def forward(self, image, action):
        shape = image.shape[:2]
        x = self.stem(image.flatten(0, 1))
        planes = action.flatten(0, 1)[:, :, None, None].expand(-1, -1, *x.shape[2:])
        joined = torch.cat([x, planes], 1)
        s, z = self.s(joined), self.z(joined)
        # The static branch sees the pictures by themselves.
        background = self.background(self.stem(image.flatten(0, 1)))
        return tuple(e.flatten(1).unflatten(0, shape) for e in (s, z, background))


class Decoder(nn.Module):
    def __init__(self, inputs, channels):
        super().__init__()
        self.input = nn.Linear(inputs, 32 * DEPTH)
        self.up = nn.Sequential(
            nn.ConvTranspose2d(32 * DEPTH, 4 * DEPTH, 5, 2), nn.ELU(),
            nn.ConvTranspose2d(4 * DEPTH, 2 * DEPTH, 5, 2), nn.ELU(),
            nn.ConvTranspose2d(2 * DEPTH, DEPTH, 6, 2), nn.ELU(),
            nn.ConvTranspose2d(DEPTH, channels, 6, 2),
        )

    def forward(self, x):
        return self.up(self.input(x)[..., None, None])


class Branch(nn.Module):
    def __init__(self):
        super().__init__()
        self.input = nn.Linear(STOCH + ACTIONS, HIDDEN)
        self.gru, self.norm = nn.Linear(HIDDEN + DETER, 3 * DETER), nn.LayerNorm(3 * DETER)
        self.prior = nn.Sequential(nn.Linear(DETER, HIDDEN), nn.ELU(), nn.Linear(HIDDEN, 2 * STOCH))
        self.posterior = nn.Sequential(nn.Linear(DETER + EMBED, HIDDEN), nn.ELU(), nn.Linear(HIDDEN, 2 * STOCH))

    def transition(self, stoch, action, deter):
        x = F.elu(self.input(torch.cat([stoch, action], -1)))
        reset, candidate, update = self.norm(self.gru(torch.cat([x, deter], -1))).chunk(3, -1)
        candidate, update = torch.tanh(torch.sigmoid(reset) * candidate), torch.sigmoid(update - 1)
        return update * candidate + (1 - update) * deter

    @staticmethod
    def stats(raw):
        mean, std = raw.chunk(2, -1)
        return mean, 2 * torch.sigmoid(std / 2) + 0.1


def draw(stats):
    return stats[0] + stats[1] * torch.randn_like(stats[1])


class World(nn.Module):
    def __init__(self):
        super().__init__()
        self.encoder, self.s, self.z = Encoder(), Branch(), Branch()
        self.gate, self.merge = nn.Linear(2 * DETER, 1), nn.Linear(2 * STOCH, STOCH)
        self.decode_s, self.decode_z = Decoder(FEAT, 4), Decoder(FEAT, 4)
        self.decode_background = Decoder(BACKGROUND * EMBED, 3)
        self.reward, self.inverse = mlp(2 * FEAT, 2, 1), mlp(EMBED, 2, ACTIONS)

    def gated(self, s, h, z, k):
        soft = torch.sigmoid(self.gate(torch.cat([k, h], -1)))
        opening = (soft >= 0.5).float() + soft - soft.detach()
        return self.merge(torch.cat([z, opening * s], -1)), opening

    def step(self, state, action, hypothetical):
        """Both branches one step on, with the transitions under other actions that the constraints compare."""
        s, h, z, k = state
        z_in, opening = self.gated(*state)
        none = torch.zeros_like(action)
        deters = [self.s.transition(s, action, h), self.z.transition(z_in, none, k)]
        if hypothetical:
            deters += [self.s.transition(s, -action, h)]
            deters += [self.z.transition(z_in, a, k) for a in (action, -action)]
        return deters, opening

    def loss(self, image, action, reward, lap):
        batch, length = action.shape[:2]
        embed_s, embed_z, embed_background = self.encoder(image, action)
        lap("encoder")
        state = [action.new_zeros(batch, n) for n in (STOCH, DETER, STOCH, DETER)]
        states, priors, posteriors, deters, openings = [], [], [], [], []
        for t in range(length):
            deter, opening = self.step(state, action[:, t], True)
            prior = [b.stats(b.prior(h)) for b, h in ((self.s, deter[0]), (self.z, deter[1]))]
            posterior = [
                b.stats(b.posterior(torch.cat([h, e[:, t]], -1)))
                for b, h, e in ((self.s, deter[0], embed_s), (self.z, deter[1], embed_z))
            ]
            state = [draw(posterior[0]), deter[0], draw(posterior[1]), deter[1]]
            for out, value in zip((states, priors, posteriors, deters, openings), (state, prior, posterior, deter, opening)):
                out.append(value)
        lap("dynamics")
        stack = lambda rows: [torch.stack(part, 1) for part in zip(*rows)]
        s, h, z, k = states = stack(states)
        priors = [stack([p[i] for p in priors]) for i in range(2)]
        posteriors = [stack([p[i] for p in posteriors]) for i in range(2)]
        h_real, k_real, h_opposite, k_action, k_opposite = stack(deters)
        half = length // 2
        s_seen = torch.cat([s[:, :half], draw(priors[0])[:, half:]], 1)
        background = self.decode_background(embed_background[:, :BACKGROUND].flatten(1)).clamp(-0.5, 0.5)
        pictures = []
        for t in range(length):
            a = self.decode_s(torch.cat([s_seen[:, t], h[:, t]], -1))
            b = self.decode_z(torch.cat([z[:, t], k[:, t]], -1))
            mask_s, mask_z = torch.sigmoid(a[:, 3:]), torch.sigmoid(b[:, 3:])
            rgb = mask_s * a[:, :3].clamp(-0.5, 0.5) + mask_z * b[:, :3].clamp(-0.5, 0.5)
            pictures.append(rgb + (1 - mask_s - mask_z) * background)
        lap("decoder")
        normal = torch.distributions.Normal
        total = -normal(torch.stack(pictures, 1), 1.0).log_prob(image).sum((2, 3, 4)).mean()
        predicted = self.reward(torch.cat(states, -1)).squeeze(-1)
        total = total - 2 * normal(predicted, 1.0).log_prob(reward).mean()
        moved = self.inverse(embed_s[:, 1:] - embed_s[:, :-1])
        total = total - normal(moved, 1.0).log_prob(action[:, 1:]).sum(-1).mean()
        divergence = lambda q, p: torch.distributions.kl_divergence(normal(*q), normal(*p)).sum(-1).mean().clamp_min(1.0)
        cut = lambda stats: [part.detach() for part in stats]
        for q, p in zip(posteriors, priors):
            total = total + 0.8 * divergence(cut(q), p) + 0.2 * divergence(q, cut(p))
        total = total + F.cosine_similarity(h_real, h_opposite, -1).abs().mean()
        total = total + (k_real - k_opposite).square().sum() + (k_action - k_real).square().sum()
        total = total + torch.stack(openings, 1).mean()
        lap("losses")
        return total, [part.detach().flatten(0, 1) for part in states]


class Behavior(nn.Module):
    def __init__(self, as_published):
        super().__init__()
        self.as_published = as_published
        self.actor, self.slow_critic = mlp(FEAT, 4, 2 * ACTIONS), mlp(FEAT, 3, 1)
        self.critic = nn.ModuleDict({
            "value": mlp(FEAT, 3, 1),
            **{name: nn.Linear(FEAT, DIM) for name in ("query", "key", "read")},
            "out": nn.Linear(DIM, FEAT),
        })

    def attend(self, feat, memory):
        c = self.critic
        weights = torch.softmax(c["query"](feat)[:, None] @ c["key"](memory).transpose(1, 2) / DIM**0.5, -1)
        return c["out"]((weights @ c["read"](memory))[:, 0]) + feat

    def policy(self, feat):
        mean, std = self.actor(feat).chunk(2, -1)
        return torch.distributions.Normal(torch.tanh(mean), 2 * torch.sigmoid(std / 2) + 0.1)

    def look_ahead(self, world, state):
        with torch.no_grad():
            z, k = world.gated(*state)[0], state[3]
            memory = [torch.cat([z, k], -1)]
            none = z.new_zeros(len(z), ACTIONS)
            for _ in range(WINDOW - 1):
                k = world.z.transition(z, none, k)
                z = draw(world.z.stats(world.z.prior(k)))
                memory.append(torch.cat([z, k], -1))
            if self.as_published:
                draw(world.z.stats(world.z.prior(world.z.transition(z, none, k))))
            return torch.stack(memory, 1)

    def losses(self, world, state, lap):
        states, features, entropies = [], [], []
        for _ in range(HORIZON):
            memory = self.look_ahead(world, state)
            controllable = torch.cat(state[:2], -1)
            feature = self.attend(controllable, memory)
            policy = self.policy(feature.detach())
            states.append(torch.cat(state, -1))
            features.append(feature)
            entropies.append(policy.entropy().sum(-1))
            (h, k, *_), _ = world.step(state, policy.rsample(), self.as_published)
            state = [draw(world.s.stats(world.s.prior(h))), h, draw(world.z.stats(world.z.prior(k))), k]
        lap("imagine")
        if self.as_published:
            unused, policies = ([self.policy(feature.detach()) for feature in features] for _ in range(2))
            entropies = [policy.entropy().sum(-1) for policy in policies]
        reward = world.reward(torch.stack(states)).squeeze(-1)
        value = self.slow_critic(torch.stack(features)).squeeze(-1)
        target, targets = value[-1], []
        for t in reversed(range(HORIZON - 1)):
            target = reward[t] + DISCOUNT * ((1 - LAMBDA) * value[t + 1] + LAMBDA * target)
            targets.insert(0, target)
        targets = torch.stack(targets)
        weights = DISCOUNT ** torch.arange(HORIZON - 1.0)[:, None]
        actor = -(weights * (targets + ENTROPY * torch.stack(entropies[:-1]))).mean()
        predicted = torch.distributions.Normal(self.critic["value"](torch.stack(features[:-1])).squeeze(-1), 1.0)
        lap("values")
        return actor, -(weights * predicted.log_prob(targets.detach())).mean()


def descend(optimizer, loss, keep_graph=False):
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    gradients = torch.autograd.grad(loss, parameters, retain_graph=keep_graph, allow_unused=True)
    for parameter, gradient in zip(parameters, gradients):
        parameter.grad = gradient
    nn.utils.clip_grad_norm_(parameters, 100.0)
    optimizer.step()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--length", type=int, default=32)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--as-published", action="store_true", help="with the published code's unused work")
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    world, behavior = World(), Behavior(args.as_published)
    adam = lambda module, lr: torch.optim.Adam(module.parameters(), lr, eps=1e-5)
    optimizers = adam(world, 3e-4), adam(behavior.actor, 8e-5), adam(behavior.critic, 8e-5)
    image = torch.rand(args.batch, args.length, 3, 64, 64) - 0.5
    action = torch.rand(args.batch, args.length, ACTIONS) * 2 - 1
    best = None
    for step in range(args.steps + 1):
        phases, last = {}, [time.perf_counter(), time.process_time()]

        def lap(name):
            now = [time.perf_counter(), time.process_time()]
            phases[name] = [b - a for a, b in zip(last, now)]
            last[:] = now

        total, states = world.loss(image, action, action[:, :, 0], lap)
        descend(optimizers[0], total)
        lap("world model backward")
        actor, critic = behavior.losses(world, states, lap)
        descend(optimizers[1], actor, keep_graph=True)
        lap("actor backward")
        descend(optimizers[2], critic)
        lap("critic backward")
        wall, cpu = (sum(phase[i] for phase in phases.values()) for i in range(2))
        # The first step fills caches and allocators.
        if step and (best is None or wall < best["wall_seconds_per_step"]):
            best = {
                "wall_seconds_per_step": wall,
                "cpu_seconds_per_step": cpu,
                "phases": [{"name": n, "wall_seconds": w, "cpu_seconds": c} for n, (w, c) in phases.items()],
            }
    best |= {
        "batch": args.batch,
        "length": args.length,
        "threads": torch.get_num_threads(),
        "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }
    print(json.dumps(best, indent=2))


if __name__ == "__main__":
    main()
