//! Space of the database file: pages that deleted records leave are given back to the file system.

use super::{Result, Store};

/// Value of `PRAGMA auto_vacuum` for files whose free pages can be given back in small steps.
const INCREMENTAL: i64 = 2;

impl Store {
    /// Number of free pages in the file. New records use them first.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn free_pages(&self) -> Result<u64> {
        let free: i64 = sqlx::query_scalar("PRAGMA freelist_count").fetch_one(&self.read).await?;
        Ok(free as u64)
    }

    /// Number of pages in the file.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn pages(&self) -> Result<u64> {
        let pages: i64 = sqlx::query_scalar("PRAGMA page_count").fetch_one(&self.read).await?;
        Ok(pages as u64)
    }

    /// Takes one step of giving free pages back: [`Store::STEP_PAGES`], or all if there are fewer. Other writers wait for one
    /// step only.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn give_back_step(&self) -> Result<()> {
        let mut tx = self.begin().await?;
        sqlx::query("PRAGMA incremental_vacuum(256)").execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Pages that [`Store::give_back_step`] gives back: 1 MiB.
    pub const STEP_PAGES: u64 = 256;

    /// Whether free pages can be given back. A file of an older version cannot do so before [`Store::rewrite`].
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails.
    pub async fn can_give_back(&self) -> Result<bool> {
        let mode: i64 = sqlx::query_scalar("PRAGMA auto_vacuum").fetch_one(&self.read).await?;
        Ok(mode == INCREMENTAL)
    }

    /// Writes the whole file anew, without free pages, so that it can give back free pages from then on. Needs room for two
    /// copies of the file; without it, the file stays as it is.
    ///
    /// # Errors
    /// [`Error`](super::Error) when the database fails, or another process uses it.
    pub async fn rewrite(&self) -> Result<()> {
        let mut writer = self.writer().await?;
        // Takes effect when the file is written anew.
        sqlx::query("PRAGMA auto_vacuum = INCREMENTAL").execute(&mut *writer).await?;
        sqlx::query("VACUUM").execute(&mut *writer).await?;
        Ok(())
    }
}
