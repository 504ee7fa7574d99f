//! Run-time dispatch: a loop that the compiler vectorises is compiled a second time for AVX2.

/// Defines a function whose body, an `#[inline(always)]` function of the same arguments, also exists for AVX2 and FMA; which of both
/// runs is decided by what the processor has. Both give the same bits: the compiler contracts no multiplication and addition by itself.
#[macro_export]
macro_rules! dispatch {
    ($(#[$doc:meta])* $vis:vis $name:ident, $body:ident, $avx2:ident, ($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)?) => {
        $(#[$doc])*
        // wasm: a function of its own is made quick while the first run goes on, one that was inlined is not
        #[inline(never)]
        #[allow(unsafe_code, reason = "the call is guarded by the test for the features that it needs")]
        $vis fn $name($($arg: $ty),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: both features were just found.
                return unsafe { $avx2($($arg),*) };
            }
            $body($($arg),*)
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma")]
        fn $avx2($($arg: $ty),*) $(-> $ret)? {
            $body($($arg),*)
        }
    };
}

pub use dispatch;
