# SPDX-License-Identifier: Apache-2.0
"""SLAM as a training signal for your own model: python examples/slam_loss.py RECORDING STEPS

The model here is small: it learns to undo a distortion of the clouds (each is scaled and shifted along x). Its task
loss is the distance to the clean cloud. The SLAM loss compares the trajectory of its output with that of clean clouds.
Prints both losses before and after. In 20 steps the first falls to about a sixtieth, the second to a twentieth or less,
also on KITTI. Too few POINTS do not determine a registration: with 400 points the SLAM loss on KITTI 04 was 14 times as
large after 20 steps, although the clouds were nearly right.
"""

import sys

import numpy as np
import torch
from torch import Tensor, nn

from dpm2_core import open_source
from dpm2_core.diffslam import SlamLoss

WINDOW, POINTS, GAMMA = 3, 1000, 0.1


class Undistort(nn.Module):
    """(T, N, 3) to (T, N, 3): one scale and one shift for all clouds."""

    def __init__(self) -> None:
        super().__init__()
        self.scale, self.shift = nn.Parameter(torch.ones(3)), nn.Parameter(torch.zeros(3))

    def forward(self, clouds: Tensor) -> Tensor:
        """The corrected clouds."""
        return clouds * self.scale + self.shift


torch.manual_seed(0)
noise = np.random.default_rng(0)
scans = [frame.points[:, :3] for frame in open_source(sys.argv[1]).frames(0, WINDOW)]
clean = torch.from_numpy(np.stack([scan[noise.choice(len(scan), POINTS, replace=False)] for scan in scans])).double()
distorted = clean * torch.tensor([1.05, 1.0, 1.0]) + torch.tensor([0.3, 0.0, 0.0])

model, slam_loss = Undistort().double(), SlamLoss()
optimizer = torch.optim.Adam(model.parameters(), lr=0.02)
for step in range(int(sys.argv[2]) + 1):
    predicted = model(distorted)
    task, slam = (predicted - clean).square().mean(), slam_loss(predicted, clean)
    if step in (0, int(sys.argv[2])):
        print(f"step {step}: task {task.item():.5f} SLAM {slam.item():.5f}")
    optimizer.zero_grad()
    (task + GAMMA * slam).backward()
    optimizer.step()
