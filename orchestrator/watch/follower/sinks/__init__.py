"""Programs that keep the curves of runs: MLflow, TensorBoard, Weights & Biases."""
