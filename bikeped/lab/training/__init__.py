"""The detector's own tooling: augmentation, training, export and evaluation. Never on the pole."""
