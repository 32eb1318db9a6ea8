"""CAVs sense, encode and upload; CVs report where they are."""
