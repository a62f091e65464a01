"""Training of DSOM: ground truth, losses, batches made on the device, the loop."""
