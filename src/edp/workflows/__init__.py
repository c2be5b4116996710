"""What users run, end to end: trainings, searches, compression, transfer, pre-training, adaptation, parity."""
