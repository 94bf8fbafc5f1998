"""Copies one job of a stopped server with its rows, so that the database holds many: many_jobs.py DATABASE JOBS ROWS."""

import sqlite3
import sys
import uuid

database, jobs, rows = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
db = sqlite3.connect(database)
columns = [row[1] for row in db.execute("PRAGMA table_info(jobs)")]
first = dict(zip(columns, db.execute("SELECT * FROM jobs ORDER BY number LIMIT 1").fetchone()))
metric_columns = [row[1] for row in db.execute("PRAGMA table_info(metrics)")]
sample = dict(zip(metric_columns, db.execute("SELECT * FROM metrics WHERE job = ? AND name = 'eval/mean_aoi' LIMIT 1", (first["number"],)).fetchone()))
names = ["eval/mean_aoi", "train/mean_aoi", "loss", "q_tot"]


def insert(table, values):
    db.execute(f"INSERT OR IGNORE INTO {table} ({', '.join(values)}) VALUES ({', '.join('?' * len(values))})", list(values.values()))


for job in range(jobs):
    number = first["number"] + 1000 + job
    insert("jobs", {**first, "number": number, "id": str(uuid.UUID(int=(0x0190 << 112) + (7 << 76) + (2 << 62) + job))})
    for row in range(rows // len(names)):
        for k, name in enumerate(names):
            insert("metrics", {**sample, "job": number, "name": name, "step": 500 * row, "value": 10 + 30 / (1 + row / 40) + k + job % 7, "seq": row + 1})
db.commit()
