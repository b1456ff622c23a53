"""Training of one network: schedule, augmentation, the training loop and its fast convolutions."""
