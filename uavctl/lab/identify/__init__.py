"""What a recording tells of the vehicle and of the link: plant, lag, disturbance, losses and delays."""

from __future__ import annotations
