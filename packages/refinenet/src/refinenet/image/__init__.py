"""What is done to pixels: crops, augmentation, gradients, masks."""
