"""The steps of `mlp_step.rs` in PyTorch on the CPU: the same shapes, batches and optimiser. Run both one after the other on
the same machine: `cargo bench -p mb-neural --bench mlp_step && python crates/neural/benches/pytorch.py`."""

import time

import torch


class Trunk(torch.nn.Module):
    """63 - 8 x 256 - 257 with the input again at layer 5 (the original NeRF)."""

    def __init__(self):
        super().__init__()
        sizes = [63] + [256] * 4 + [256 + 63] + [256] * 2
        self.layers = torch.nn.ModuleList([torch.nn.Linear(n, 256) for n in sizes])
        self.last = torch.nn.Linear(256, 257)

    def forward(self, x):
        h = x
        for k, layer in enumerate(self.layers):
            h = torch.relu(layer(torch.cat([h, x], -1) if k == 5 else h))
        return self.last(h)


def small():
    linear = torch.nn.Linear
    return torch.nn.Sequential(
        linear(32, 64), torch.nn.ReLU(), linear(64, 64), torch.nn.ReLU(), linear(64, 16)
    )


print("torch", torch.__version__, torch.get_num_threads(), "threads")
for name, make, inputs, outputs, batch, steps in [
    ("32-64-64-16", small, 32, 16, 65_536, 30),
    ("32-64-64-16", small, 32, 16, 4_096, 300),
    ("63-8x256-257", Trunk, 63, 257, 8_192, 6),
]:
    torch.manual_seed(0)
    model, x = make(), torch.rand(batch, inputs) * 2 - 1
    target = torch.sin(x[:, :1] + torch.arange(outputs))
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)

    def run(n):
        for _ in range(n):
            optimizer.zero_grad(set_to_none=True)
            loss = ((model(x) - target) ** 2).mean()
            loss.backward()
            optimizer.step()
        return float(loss)

    run(3)
    wall, cpu = time.perf_counter(), time.process_time()
    loss = run(steps)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{name}, batch {batch}: {steps / wall:.2f} steps/s wall, {cpu / steps:.4f} CPU s a step, loss {loss:.5f}")
