"""The personal flow: trial, job, fine-tuning, judgement, promotion."""
