"""What the driver itself makes between the tasks of workers: the partition, models joined, an evaluation."""
