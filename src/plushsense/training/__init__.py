"""Train one network: schedule, augmentation, training loop and fast convolutions."""
