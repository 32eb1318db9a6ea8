"""Vehicle agents: CAVs sense, encode and upload; CVs report their pose. All in `role`."""
