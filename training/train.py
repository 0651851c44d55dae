"""Train a descriptor and a metric on a folder of labelled meshes, or test them.

    python -m training.train fit --config configs/own.yaml
    python -m training.train fit --config configs/own.yaml --resume last
    python -m training.train test --config configs/own.yaml --ckpt_path build/own/checkpoints/best.ckpt

Every option of the learner, the data and the trainer can be set in the file or on the command line. A checkpoint also
holds the configuration: `RetrievalLearner.load_from_checkpoint` and `SignatureDataModule.load_from_checkpoint` read it.
"""

from igps.cli import errors_as_messages
from training.running import Run

if __name__ == "__main__":
    with errors_as_messages():
        Run()
